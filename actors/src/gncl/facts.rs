//! What GNCL says to the other layers.

use sinew_runtime::tid::{Incarnation, NodeAddress};

use crate::last_words::LastWords;

/// A change of the connection to a node, told to NDL and to the sync manager.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum LinkFact {
    /// Messages can flow.
    LinkUp { node: NodeAddress, incarnation: Incarnation },
    /// The connection ended; GNCL dials again by itself.
    LinkBroken { node: NodeAddress, incarnation: Incarnation },
    /// A dial was refused by the peer's host: nobody listens there any more.
    DialRefused { node: NodeAddress, incarnation: Incarnation },
    /// The peer said goodbye: its node stops in order, or gave up for this reason.
    PeerLeft { node: NodeAddress, incarnation: Incarnation, gave_up: Option<LastWords> },
}
