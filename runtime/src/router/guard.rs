//! The access check of messages, at the end of every route to an application of this node.
//!
//! A [`Guard`] is stored in the routing table itself, which every sender reads anyway: without one, a message
//! costs one read of a pointer. Messages from other nodes, from other processes and from this process pass
//! the same check at the same place.

use std::sync::Arc;

use super::{Table, mismatches};
use crate::{
    outcome::Rejection,
    tid::AppAddress,
    wire::{Flags, Header},
};

/// The access check. It is called on the sending thread, for every message, so it must not block or hold a
/// lock for long.
pub trait Guard: Send + Sync {
    /// Returns whether the message of this header may reach the application of this node at `target`. Its
    /// destination may be a group of the application, or every application. It is called once for each target
    /// of a message, and again each time that a message is offered again after a full queue.
    fn allows(&self, header: &Header, target: AppAddress) -> bool;

    /// Reports that an application of this node sends a request to one application; called before the request
    /// can be answered.
    fn asks(&self, header: &Header);
}

/// Returns whether the message of this header must not reach `target`.
///
/// Messages from and to layers are checked by their protocols.
#[inline]
fn refuses(guard: Option<&Arc<dyn Guard>>, target: AppAddress, header: &Header) -> bool {
    guard.is_some_and(|guard| is_guarded(header, target) && !guard.allows(header, target))
}

/// Returns why the message of this header must not reach `target`: the guard, or a type that its sender declared
/// differently. `None`: it may.
#[inline]
pub(super) fn why_refused(
    table: &Table,
    guard: Option<&Arc<dyn Guard>>,
    target: AppAddress,
    header: &Header,
) -> Option<Rejection> {
    if refuses(guard, target, header) {
        return Some(Rejection::NotAllowed);
    }
    mismatches::refuses(table.mismatches.as_ref(), target, header).then_some(Rejection::Malformed)
}

/// Returns whether the message is subject to a guard.
const fn is_guarded(header: &Header, target: AppAddress) -> bool {
    header.kind.is_user() && !target.is_layer()
}

/// Reports a request to the guard, if the message is one.
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
        router::{LocalRoute, MessageSink, Router, SubmitError},
        tid::{NodeAddress, Tid},
        wire::{Kind, Message},
    };

    const NODE: NodeAddress = NodeAddress::new(0x7f00_0001);
    const HEIR: AppAddress = AppAddress::new(0x1001);

    struct Sink;

    impl MessageSink for Sink {
        fn submit(&self, _: Message) -> Result<(), SubmitError> {
            Ok(())
        }
    }

    /// Returns the same verdict for everything, and checks that the application's route has no additional
    /// owner.
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
    fn replaced_guard_applies_without_copying_the_table() {
        let (router, route) = (Router::new(NODE), Arc::new(Sink));
        router.set_local(HEIR, LocalRoute { sink: route.clone(), events: Arc::new([]) });
        // Here, in the guard, and in the table that senders read.
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
