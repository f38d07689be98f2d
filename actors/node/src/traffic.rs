//! The outcomes of a node's messages to other nodes.

use std::sync::Arc;

use sinew_gncl::Peer;
use sinew_runtime::tid::NodeAddress;
use sinew_session::outlet::OutletCounts;

use super::NodeHandle;

/// The outcomes of the messages to another node, since the link with its present incarnation was established.
/// Every message is counted: submitted = sent + superseded + expired + lost + refused + waiting.
///
/// # Examples
///
/// ```no_run
/// use sinew::{NodeHandle, node::Traffic};
///
/// /// The nodes to which messages were lost.
/// fn with_losses(handle: &NodeHandle) -> Vec<Traffic> {
///     handle.traffic().into_iter().filter(|traffic| traffic.counts.lost > 0).collect()
/// }
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Traffic {
    /// The other node.
    pub node: NodeAddress,
    /// The outcomes.
    pub counts: OutletCounts,
    /// Messages that wait to be sent.
    pub waiting: usize,
    /// Confirmed messages without an outcome.
    pub unconfirmed: usize,
}

impl NodeHandle {
    /// Returns the outcomes of the messages to each node that is linked or expected back.
    #[must_use]
    pub fn traffic(&self) -> Vec<Traffic> {
        let traffic = |peer: Arc<Peer>| Traffic {
            node: peer.node,
            counts: peer.counts(),
            waiting: peer.waiting(),
            unconfirmed: peer.unconfirmed(),
        };
        self.state.gncl.store.peers().into_iter().map(traffic).collect()
    }
}
