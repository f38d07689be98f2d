//! Resolves which of several applications with one name the messages of a node reach.

use sinew::{Tid, inspect::NodeReport};

/// An application that has the name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Resolved {
    /// The index of its node among the asked ones.
    pub(super) at: usize,
    pub(super) tid: Tid,
    /// As reported by its own node.
    pub(super) is_ready: bool,
}

/// Puts first the application that messages of the reporting node reach: the node's own one, ready or not; else a ready
/// one, then one of a linked node, then the lowest address. Applications of nodes that the reporting node does not know
/// are last: its messages do not reach them.
/// spec: SYNC-6
pub(super) fn sort_by_reachability(resolved: &mut [Resolved], from: &NodeReport) {
    resolved.sort_by_key(|Resolved { tid, is_ready, .. }| {
        let is_own = tid.node == from.node;
        let peer = from.peers.iter().find(|peer| peer.node == tid.node && peer.is_there);
        let is_linked = peer.is_some_and(|peer| peer.linked_us.is_some());
        let is_reached = is_linked || is_own;
        (!is_own, !is_own && peer.is_none(), !(is_reached && *is_ready), !is_reached, *tid)
    });
}

#[cfg(test)]
mod tests {
    use sinew::{AppAddress, NodeAddress, address::Incarnation, inspect::PeerReport};

    use super::*;
    use crate::security;

    fn node(number: u8) -> NodeAddress {
        NodeAddress::from([192, 168, 0, number])
    }

    fn resolved(number: u8, is_ready: bool) -> Resolved {
        let tid = Tid::new(node(number), AppAddress::new(0x1001));
        Resolved { at: number.into(), tid, is_ready }
    }

    /// Node 5, which is linked to 2, 3 and 4, knows 6 without a link to it, and has lost 1.
    fn from() -> NodeReport {
        let peer = |number: u8| PeerReport {
            is_there: true,
            linked_us: Some(1),
            ..PeerReport::lost(node(number), Incarnation(1))
        };
        let mut peers: Vec<_> = [2, 3, 4, 6].map(peer).to_vec();
        peers[3].linked_us = None;
        peers.insert(0, PeerReport::lost(node(1), Incarnation(1)));
        NodeReport { peers, ..security::tests::node_report("hip", 5, None) }
    }

    /// Returns the nodes in the order in which the name resolves to them.
    fn order<const N: usize>(mut resolved: [Resolved; N]) -> [usize; N] {
        sort_by_reachability(&mut resolved, &from());
        resolved.map(|one| one.at)
    }

    // spec: SYNC-6
    #[test]
    fn name_prefers_own_then_ready_then_linked_then_lowest() {
        assert_eq!(order([resolved(2, true), resolved(5, false)]), [5, 2], "its own, though it is not ready");
        assert_eq!(
            order([resolved(2, false), resolved(3, true), resolved(4, true)]),
            [3, 4, 2],
            "ready ones first"
        );
        // Readiness does not count without a connection.
        assert_eq!(order([resolved(6, true), resolved(4, false), resolved(2, false)]), [2, 4, 6]);
        assert_eq!(order([resolved(6, true), resolved(3, true)]), [3, 6]);
    }

    #[test]
    fn name_resolves_to_unknown_nodes_last() {
        assert_eq!(order([resolved(1, true), resolved(9, true), resolved(6, false)]), [6, 1, 9]);
    }
}
