//! The access check of messages, at the end of every route to an application of this node.
//!
//! A [`Guard`] is stored in the routing table itself, which every sender reads anyway: without one, a message
//! costs one read of a pointer. Messages from other nodes, from other processes and from this process pass
//! the same check at the same place.

use std::sync::Arc;

use bytes::Bytes;

use sinew_params::SetParameters;

use super::{
    Table,
    mismatches::{self, Mismatches, SPOILED},
};
use crate::{
    outcome::Rejection,
    tid::{AppAddress, NodeAddress},
    wire::{Flags, Header, Message, Payload},
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

    /// Reports that a set of parameters may reach its application of this node: it may name the participants of a
    /// transaction, which send each other messages.
    fn sets(&self, _set: &Message) {}
}

/// The senders that may set parameters of this node's applications, in addition to a [`Guard`].
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum ParameterRight {
    /// Each sender of a message that may reach the application: a guard decides, if there is one.
    #[default]
    Any,
    /// Applications and clients of this node.
    OfNode(NodeAddress),
    /// No sender.
    Nobody,
}

impl ParameterRight {
    /// Returns whether this right refuses the message of this header.
    #[inline]
    fn refuses(self, header: &Header) -> bool {
        if header.kind != SetParameters::KIND {
            return false;
        }
        match self {
            Self::Any => false,
            Self::OfNode(node) => header.source.node != node,
            Self::Nobody => true,
        }
    }
}

/// Returns whether the message of this header must not reach `target`.
///
/// Messages from and to layers are checked by their protocols.
#[inline]
fn refuses(guard: Option<&Arc<dyn Guard>>, target: AppAddress, header: &Header) -> bool {
    guard.is_some_and(|guard| is_guarded(header, target) && !guard.allows(header, target))
}

/// The result of the checks of a message for one application.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Verdict {
    /// It may reach the application.
    Allowed,
    /// It must not.
    Refused(Rejection),
    /// It may, without its value: it is protected, and its sender declared its type differently.
    Spoiled,
}

/// The checks of one message.
#[derive(Clone, Copy)]
pub(super) struct Judge<'a> {
    /// `None`: no restriction.
    pub(super) guard: Option<&'a Arc<dyn Guard>>,
    /// `None`: no types differ, or they do not matter.
    pub(super) mismatches: Option<&'a Arc<Mismatches>>,
    pub(super) parameters: ParameterRight,
}

impl Table {
    /// Returns the checks of a message to an application of this node.
    #[inline]
    pub(super) fn judge(&self) -> Judge<'_> {
        Judge {
            guard: self.guard.as_ref(),
            mismatches: self.mismatches.as_ref(),
            parameters: self.parameters,
        }
    }
}

impl Judge<'_> {
    #[inline]
    fn of(self, target: AppAddress, header: &Header) -> Verdict {
        if refuses(self.guard, target, header) || self.parameters.refuses(header) {
            return Verdict::Refused(Rejection::NotAllowed);
        }
        mismatches::judge(self.mismatches, target, header)
    }

    /// Returns why the message of this header to many must not reach `target`: the guard, or a type that its sender
    /// declared differently. `None`: it may. A message to many is not protected.
    #[inline]
    pub(super) fn why_refused(self, target: AppAddress, header: &Header) -> Option<Rejection> {
        match self.of(target, header) {
            Verdict::Allowed => None,
            Verdict::Refused(why) => Some(why),
            Verdict::Spoiled => Some(Rejection::Malformed),
        }
    }

    /// Returns why this message must not reach its one application. `None`: it may, perhaps without its value.
    #[inline]
    pub(super) fn check(self, message: &mut Message) -> Option<Rejection> {
        match self.of(message.header.destination.app, &message.header) {
            Verdict::Allowed => {
                if let Some(guard) = self.guard
                    && message.header.kind == SetParameters::KIND
                {
                    guard.sets(message);
                }
                None
            }
            Verdict::Refused(why) => Some(why),
            Verdict::Spoiled => {
                message.payload = Bytes::from_static(SPOILED);
                None
            }
        }
    }
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
    use super::*;
    use crate::{
        router::{LocalRoute, MessageSink, Router, SubmitError},
        tid::{NodeAddress, Tid},
        wire::Kind,
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
    fn parameters_are_set_only_by_senders_with_right() {
        let (router, route) = (Router::new(NODE), Arc::new(Sink));
        router.set_local(HEIR, LocalRoute { sink: route, events: Arc::new([]) });
        let (here, elsewhere) = (NODE, NodeAddress::new(0x7f00_0002));
        let send = |node, kind| {
            let header = Header::new(kind, Tid::new(node, AppAddress::new(0x1002)), Tid::new(NODE, HEIR));
            router.deliver(Message::new(header, Bytes::new()))
        };
        let other = Kind::named("test.other");
        for (right, local, remote) in [
            (ParameterRight::Any, Ok(()), Ok(())),
            (ParameterRight::OfNode(NODE), Ok(()), Err(Rejection::NotAllowed)),
            (ParameterRight::Nobody, Err(Rejection::NotAllowed), Err(Rejection::NotAllowed)),
        ] {
            router.set_parameter_right(right);
            assert_eq!(send(here, SetParameters::KIND), local, "{right:?}");
            assert_eq!(send(elsewhere, SetParameters::KIND), remote, "{right:?}");
            assert_eq!((send(here, other), send(elsewhere, other)), (Ok(()), Ok(())), "{right:?}");
        }
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
            let judged = router.deliver_will(to(HEIR), Some(&guard(allows)));
            assert_eq!(judged, if allows { Ok(()) } else { Err(Rejection::NotAllowed) });
            let mut to_all = to(HEIR);
            to_all.header.destination = everybody;
            assert_eq!(router.deliver_will(to_all, Some(&guard(allows))), Ok(()));
        }
        assert_eq!(router.deliver(to(HEIR)), Ok(()), "the table itself has no guard");
    }
}
