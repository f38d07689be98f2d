//! Who may send what to whom, asked where every route to an application of this node ends.
//!
//! A [`Guard`] stands in the routing table itself, which every sender reads anyway: while there is none, a message costs one look at a
//! pointer. What comes from other nodes, from other processes and from this one is asked the same question at the same place.

use std::sync::Arc;

use crate::{
    tid::AppAddress,
    wire::{Flags, Header},
};

/// Whoever decides. It is called on the thread of whoever sends, for every message, so it neither waits nor holds a lock for long.
pub trait Guard: Send + Sync {
    /// Whether what this header says may reach the application of this node at `target`; its destination may be a group that the
    /// application is a member of, or every application. It is told of each message once for each target, and of one that found a full
    /// queue each time that it is offered again.
    fn allows(&self, header: &Header, target: AppAddress) -> bool;

    /// An application of this node sends this question to one application; said before anybody can answer it.
    fn asks(&self, header: &Header);
}

/// Whether what this header says may not reach `target`.
///
/// What layers say, and what is said to them, is their protocols' business.
#[inline]
pub(super) fn refuses(guard: Option<&Arc<dyn Guard>>, target: AppAddress, header: &Header) -> bool {
    guard.is_some_and(|guard| is_guarded(header, target) && !guard.allows(header, target))
}

/// Whether a guard is asked at all.
const fn is_guarded(header: &Header, target: AppAddress) -> bool {
    header.kind.is_user() && !target.is_layer()
}

/// Tells the guard of a question, if it is one.
#[inline]
pub(super) fn note(guard: Option<&Arc<dyn Guard>>, header: &Header) {
    if let Some(guard) = guard
        && header.flags.has(Flags::ASK)
        && header.kind.is_user()
        && header.destination.is_single()
    {
        guard.asks(header);
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;
    use crate::{
        outcome::Rejection,
        router::{LocalRoute, Outlet, Refused, Router},
        tid::{NodeAddress, Tid},
        wire::{Kind, Message},
    };

    const NODE: NodeAddress = NodeAddress::new(0x7f00_0001);
    const HEIR: AppAddress = AppAddress::new(0x1001);

    struct Sink;

    impl Outlet for Sink {
        fn submit(&self, _: Message) -> Result<(), Refused> {
            Ok(())
        }
    }

    /// Says the same of everything, and sees to it that nobody has another hold of the application's route than before.
    struct Same {
        allows: bool,
        route: Arc<Sink>,
        held: usize,
    }

    impl Guard for Same {
        fn allows(&self, _: &Header, _: AppAddress) -> bool {
            assert_eq!(Arc::strong_count(&self.route), self.held, "the table was copied for one message");
            self.allows
        }

        fn asks(&self, _: &Header) {}
    }

    #[test]
    fn one_message_is_judged_by_another_guard_without_a_copy_of_the_table() {
        let (router, route) = (Router::new(NODE), Arc::new(Sink));
        router.set_local(HEIR, LocalRoute { outlet: route.clone(), events: Arc::new([]) });
        // Here, in the guard, and in the table that is read.
        let guard = |allows| Arc::new(Same { allows, route: route.clone(), held: 3 }) as Arc<dyn Guard>;
        let to = |app| {
            let header = Header::new(Kind::named("test.will"), Tid::NONE, Tid::new(NODE, app));
            Message::new(header, Bytes::new())
        };
        let everybody = Tid::new(NodeAddress::ALL, AppAddress::ALL);
        for allows in [true, false] {
            let judged = router.deliver_judged_by(to(HEIR), &guard(allows));
            assert_eq!(judged, if allows { Ok(()) } else { Err(Rejection::NotAllowed) });
            let mut to_all = to(HEIR);
            to_all.header.destination = everybody;
            assert_eq!(router.deliver_judged_by(to_all, &guard(allows)), Ok(()));
        }
        assert_eq!(router.deliver(to(HEIR)), Ok(()), "the table itself has no guard");
    }
}
