//! The results of the routes, for the modules that own the sockets and the memory.

use sinew_runtime::tid::Tid;

use super::LinkNumber;

/// The effect of a mark of the peer's SWITCH.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum MarkEffect {
    /// Other marks are missing.
    Wait,
    /// All marks have arrived. The peer's offer is in the link's socket: connect, then `Routes::connected`.
    Connect {
        /// The correlation number to confirm, once connected.
        confirm: Option<u64>,
    },
    /// All marks have arrived: the peer's ring is read from now on.
    Open {
        /// The correlation number to confirm.
        confirm: Option<u64>,
    },
    /// The SWITCH was repeated.
    Known,
    /// There is no such link.
    Unknown,
}

/// The effect of an OUTCOME on a route.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum OutcomeEffect {
    /// The OUTCOME was about a route, and there is nothing to do.
    Noted,
    /// The peer does not have this link any more: end it.
    End(Tid, LinkNumber),
    /// The OUTCOME is not about a route.
    NotOurs,
}

/// Whether a closed peer has left unread data: messages in its ring, or its offer in the socket if the ring
/// is not mapped yet.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Unread {
    /// There is none.
    None,
    /// There is some.
    Some,
}

/// How to handle a message to this application that arrived through the node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum NodeDelivery {
    /// The message was sent before the source's SWITCH, or there is no link.
    Take,
    /// The message was sent after the SWITCH, by another incarnation of the source, or the source has ended
    /// this link. The content of its ring was sent before it. The source no longer reads this side's ring, so
    /// nothing is sent there any more.
    AfterLink(LinkNumber),
}

/// How to handle a peer that has closed its link.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum HangUpAction {
    /// Its ring is open: read its remaining messages, then `Routes::ended`.
    Drain,
    /// The messages that it sent through the node come first: keep the ring until its marks have arrived.
    Keep,
    /// There is no such link, or it must be empty: `Routes::ended`.
    Drop,
}
