//! GNCL's events for the other layers.

use sinew_runtime::tid::{Incarnation, NodeAddress};

use crate::leave_reason::LeaveReason;

/// A change of the connection to a node, reported to NDL and to the sync manager.
#[derive(Clone, Debug, PartialEq, Eq)]
#[expect(missing_docs, reason = "each field is what its name says")]
pub enum LinkFact {
    /// Messages can be exchanged.
    LinkUp { node: NodeAddress, incarnation: Incarnation },
    /// The connection has ended; GNCL dials again by itself.
    LinkBroken { node: NodeAddress, incarnation: Incarnation },
    /// A dial was refused by the peer's host: no process listens there any more.
    DialRefused { node: NodeAddress, incarnation: Incarnation },
    /// The peer sent GOODBYE: its node stops in order, or gave up for this reason.
    PeerLeft { node: NodeAddress, incarnation: Incarnation, gave_up: Option<LeaveReason> },
}

impl LinkFact {
    /// Returns the node and the incarnation of it that the fact is about.
    #[must_use]
    pub const fn subject(&self) -> (NodeAddress, Incarnation) {
        let (Self::LinkUp { node, incarnation }
        | Self::LinkBroken { node, incarnation }
        | Self::DialRefused { node, incarnation }
        | Self::PeerLeft { node, incarnation, .. }) = self;
        (*node, *incarnation)
    }
}
