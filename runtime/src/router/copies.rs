//! The results of the copies of a message to many.

use crate::outcome::Rejection;

/// The number of accepted copies, and the rejections of the others.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Copies {
    taken: usize,
    /// Indexed by [`Rejection`].
    refused: [u64; Rejection::ALL.len()],
}

impl Copies {
    pub(super) const fn note(&mut self, refused: Option<Rejection>) {
        match refused {
            None => self.taken += 1,
            Some(why) => self.refused[why as usize] += 1,
        }
    }

    /// Returns whether any copy was accepted.
    pub(super) const fn is_taken(&self) -> bool {
        self.taken > 0
    }

    /// Returns the copies without room. A member that a guard excludes, or that does not exist, is meant to get none.
    pub(super) fn without_room(&self) -> impl Iterator<Item = (Rejection, u64)> {
        [Rejection::QueueFull, Rejection::TooLong].into_iter().map(|why| (why, self.refused[why as usize]))
    }

    /// Returns the reason why no copy was accepted, if the sender can remedy it. `None`: no member could
    /// accept one, which is no fault.
    pub(super) fn why_none(&self) -> Option<Rejection> {
        let mendable = [Rejection::TooLong, Rejection::QueueFull, Rejection::NotAllowed];
        mendable.into_iter().find(|why| self.refused[*why as usize] > 0)
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use bytes::Bytes;

    use crate::{
        outcome::Rejection,
        router::{LocalRoute, MessageSink, Router, SubmitError},
        tid::{AppAddress, NodeAddress, Tid},
        wire::{Header, Kind, Message},
    };

    const NODE: NodeAddress = NodeAddress::new(0x7f00_0001);
    const PEER: NodeAddress = NodeAddress::new(0x7f00_0002);
    const MEMBER: AppAddress = AppAddress::new(0x1001);

    /// Accepts everything, or nothing.
    struct Sink(Option<Rejection>);

    impl MessageSink for Sink {
        fn submit(&self, message: Message) -> Result<(), SubmitError> {
            self.0.map_or(Ok(()), |why| Err(SubmitError::new(message, why)))
        }
    }

    /// A node with one member here and one at a peer; each accepts messages or rejects them for this reason.
    fn router(here: Option<Rejection>, there: Option<Rejection>) -> Router {
        let (router, group) = (Router::new(NODE), AppAddress::group("legs"));
        router.set_local(MEMBER, LocalRoute { sink: Arc::new(Sink(here)), events: Arc::new([]) });
        router.set_member(group, MEMBER, true);
        router.set_peer(PEER, Arc::new(Sink(there)));
        router.set_remote_groups(PEER, &[group]);
        router
    }

    fn to_group() -> Message {
        Message::new(Header::new(Kind::named("test.word"), Tid::NONE, Tid::group("legs")), Bytes::new())
    }

    #[test]
    fn rejected_copy_is_counted_if_another_was_accepted() {
        for (here, there) in [(None, Some(Rejection::QueueFull)), (Some(Rejection::QueueFull), None)] {
            let router = router(here, there);
            assert_eq!(router.send(to_group()), Ok(()));
            assert_eq!(router.refused_because(), [(Rejection::QueueFull, 1)]);
        }
    }

    #[test]
    fn absent_or_forbidden_member_is_no_loss() {
        for why in [Rejection::Closed, Rejection::Down, Rejection::NotAllowed] {
            let router = router(Some(why), None);
            assert_eq!(router.send(to_group()), Ok(()));
            assert_eq!(router.refused_because(), []);
        }
    }

    #[test]
    fn rejection_by_all_gives_the_remediable_reason() {
        let full = Some(Rejection::QueueFull);
        for (here, there, said) in [
            (full, full, Rejection::QueueFull),
            (Some(Rejection::Closed), full, Rejection::QueueFull),
            (Some(Rejection::TooLong), full, Rejection::TooLong),
            (Some(Rejection::NotAllowed), full, Rejection::QueueFull),
            (Some(Rejection::NotAllowed), Some(Rejection::Closed), Rejection::NotAllowed),
        ] {
            let router = router(here, there);
            assert_eq!(router.send(to_group()), Err(said));
            assert_eq!(router.refused_because(), [(said, 1)], "the message is refused once");
        }
    }

    #[test]
    fn group_without_present_members_is_no_error() {
        let router = router(Some(Rejection::Closed), Some(Rejection::Closed));
        assert_eq!(router.send(to_group()), Ok(()));
        router.remove_local(MEMBER);
        router.set_remote_groups(PEER, &[]);
        assert_eq!((router.send(to_group()), router.refused()), (Ok(()), 0));
    }

    #[test]
    fn unknown_group_is_rejected() {
        let (router, unknown) = (router(None, None), NodeAddress::new(0x7f00_0003));
        let mut message = to_group();
        message.header.destination.node = unknown;
        assert_eq!(router.send(message), Err(Rejection::NoSuchNode));
    }

    #[test]
    fn copies_of_remote_messages_are_counted_too() {
        let router = router(Some(Rejection::QueueFull), None);
        assert_eq!(router.deliver(to_group()), Ok(()));
        assert_eq!(router.refused_because(), [(Rejection::QueueFull, 1)]);
    }
}
