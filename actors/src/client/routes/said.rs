//! What the routes say of what has come, to those who have the sockets and the memory.

use sinew_runtime::tid::Tid;

use super::LinkNumber;

/// What a mark of the peer's SWITCH means.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::client) enum Marked {
    /// Others are missing.
    Wait,
    /// All have come. The peer's offer is in the link's socket: connect, then [`Routes::connected`].
    Connect {
        /// The correlation to confirm, once connected.
        confirm: Option<u64>,
    },
    /// All have come: the peer's ring is read from now on.
    Open {
        /// The correlation to confirm.
        confirm: Option<u64>,
    },
    /// It was said again.
    Known,
    /// There is no such link.
    Unknown,
}

/// What an OUTCOME meant for a route.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::client) enum Answered {
    /// It was about a route, and there is nothing to do.
    Noted,
    /// The peer does not have this link any more: end it.
    End(Tid, LinkNumber),
    /// It is not about a route.
    NotOurs,
}

/// Whether a peer that has gone has left anything: messages in its ring or, before that is mapped, its offer in the socket.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::client) enum Left {
    Nothing,
    Something,
}

/// What is to be done with a message to this application that came through the node.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::client) enum Passed {
    /// It was sent before the source's SWITCH, or there is no link.
    Take,
    /// It was sent after the SWITCH: by another life of the source, or the source has ended this link. What it wrote into
    /// its ring was sent before, and what it says to this side comes no more through that: nothing is sent there any more.
    AfterLink(LinkNumber),
}

/// What is to be done about a peer that has hung up.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(in crate::client) enum Farewell {
    /// Its ring is open: read its last words, then [`Routes::ended`].
    Read,
    /// What it sent through the node comes first: keep the ring until its marks have come.
    Keep,
    /// There is no such link, or nothing can be in it: [`Routes::ended`].
    Drop,
}
