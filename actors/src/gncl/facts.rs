//! What GNCL says to the other layers.

use sinew_runtime::tid::{Incarnation, NodeAddress};

/// A change of the connection to a node, told to NDL and to the sync manager.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum LinkFact {
    /// Messages can flow.
    LinkUp { node: NodeAddress, incarnation: Incarnation },
    /// The connection ended; GNCL dials again by itself.
    LinkBroken { node: NodeAddress, incarnation: Incarnation },
    /// A dial was refused by the peer's host: nobody listens there any more.
    DialRefused { node: NodeAddress, incarnation: Incarnation },
    /// The peer said goodbye: its node stops in order.
    PeerLeft { node: NodeAddress, incarnation: Incarnation },
}
