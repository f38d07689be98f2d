//! Which of several applications with one name a node's messages reach.

use sinew::{Tid, inspect::NodeReport};

/// An application that has the name.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Called {
    /// Its node among those that were asked.
    pub(super) at: usize,
    pub(super) tid: Tid,
    /// As its own node says.
    pub(super) is_ready: bool,
}

/// Puts the one first that messages of the node reach which says this of itself and of those that it knows: its own one, ready or not; else one
/// that is ready, then one of a linked node, then the lowest address. Behind those stand the ones of nodes that it does not know: nothing
/// of it reaches them. spec: SYNC-6
pub(super) fn by_whom_is_reached(called: &mut [Called], from: &NodeReport) {
    called.sort_by_key(|Called { tid, is_ready, .. }| {
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

    fn called(number: u8, is_ready: bool) -> Called {
        let tid = Tid::new(node(number), AppAddress::new(0x1001));
        Called { at: number.into(), tid, is_ready }
    }

    /// Node 5, which is linked to 2, 3 and 4, knows 6 and is not linked to it, and has lost 1.
    fn from() -> NodeReport {
        let peer = |number: u8| PeerReport {
            is_there: true,
            linked_us: Some(1),
            ..PeerReport::lost(node(number), Incarnation(1))
        };
        let mut peers: Vec<_> = [2, 3, 4, 6].map(peer).to_vec();
        peers[3].linked_us = None;
        peers.insert(0, PeerReport::lost(node(1), Incarnation(1)));
        NodeReport { peers, ..security::tests::said("hip", 5, None) }
    }

    /// Who is reached first, and who then.
    fn order<const N: usize>(mut called: [Called; N]) -> [usize; N] {
        by_whom_is_reached(&mut called, &from());
        called.map(|one| one.at)
    }

    // spec: SYNC-6
    #[test]
    fn a_name_stands_for_the_own_one_then_for_who_is_ready_then_for_who_is_linked_then_for_the_lowest_address()
     {
        assert_eq!(order([called(2, true), called(5, false)]), [5, 2], "its own, though it is not ready");
        assert_eq!(
            order([called(2, false), called(3, true), called(4, true)]),
            [3, 4, 2],
            "ready ones first"
        );
        // That it is ready is of no use where there is no connection.
        assert_eq!(order([called(6, true), called(4, false), called(2, false)]), [2, 4, 6]);
        assert_eq!(order([called(6, true), called(3, true)]), [3, 6]);
    }

    #[test]
    fn a_name_stands_for_one_of_a_node_that_is_not_known_only_where_no_other_has_it() {
        assert_eq!(order([called(1, true), called(9, true), called(6, false)]), [6, 1, 9]);
    }
}
