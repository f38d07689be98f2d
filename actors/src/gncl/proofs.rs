//! With which certificate each node was linked last: when that is revoked, the life that showed it has proven nothing.

use std::{collections::BTreeMap, sync::Mutex};

use sinew_runtime::tid::{Incarnation, NodeAddress};

use crate::{security::Peer, stores::lock};

/// Of each node that was linked. It outlives links, what is forgotten of a peer, and restarts of this layer: the life that was linked bars
/// earlier ones as long.
#[derive(Default)]
pub(super) struct Proofs(Mutex<BTreeMap<NodeAddress, Proof>>);

/// How a life proved itself.
struct Proof {
    incarnation: Incarnation,
    peer: Peer,
}

impl Proofs {
    /// `node` is linked in this life, as `peer`. When there are more than `nodes_max`, those go that are not `known` any more.
    pub(super) fn note(
        &self,
        (node, incarnation): (NodeAddress, Incarnation),
        peer: Peer,
        nodes_max: usize,
        known: impl Fn(NodeAddress) -> bool,
    ) {
        let mut all = lock(&self.0);
        all.insert(node, Proof { incarnation, peer });
        if all.len() > nodes_max {
            all.retain(|node, _| known(*node));
        }
    }

    /// The lives that were linked as somebody of whom `what` is true.
    pub(super) fn of_those(&self, what: impl Fn(&Peer) -> bool) -> Vec<(NodeAddress, Incarnation)> {
        let all = lock(&self.0);
        let those = all.iter().filter(|(_, proof)| what(&proof.peer));
        those.map(|(node, proof)| (*node, proof.incarnation)).collect()
    }
}
