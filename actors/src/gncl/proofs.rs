//! With which certificate each node was linked last: when that is revoked, the life that showed it has proven nothing.

use std::{collections::BTreeMap, sync::Mutex};

use sinew_runtime::tid::{Incarnation, NodeAddress};

use crate::{
    security::Peer,
    stores::{Stores, lock},
};

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

/// The life of this node that was linked last, where nodes prove who they are.
pub(crate) fn proven_life(stores: &Stores, node: NodeAddress) -> Option<Incarnation> {
    lock(&stores.gncl.proofs.0).get(&node).map(|proof| proof.incarnation)
}

/// Whether the certificate with which this life was linked is on the deny list.
pub(crate) fn is_revoked(stores: &Stores, node: NodeAddress, incarnation: Incarnation) -> bool {
    let Some(secured) = stores.secured.get() else { return false };
    stores.gncl.proofs.of_those(|peer| secured.tls.denies(peer).is_some()).contains(&(node, incarnation))
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::security::{Judged, Validity, tests::ground};

    fn peer(serial: &str) -> Peer {
        Peer {
            identity: ground::identity("hip", 1),
            serial: serial.parse().expect("a number"),
            validity: Validity { from: ground::at(0), until: ground::at(1) },
            times: Judged::Valid,
        }
    }

    #[test]
    fn the_last_certificate_of_each_node_counts_and_nodes_that_are_not_known_make_room() {
        let (proofs, [hip, knee, ankle]) = (Proofs::default(), [1, 2, 3].map(NodeAddress::new));
        let note = |node, life, serial| {
            proofs.note((node, Incarnation(life)), peer(serial), 2, |node| node != hip);
        };
        let of = |serial: &str| proofs.of_those(|shown| shown.serial == peer(serial).serial);
        note(hip, 1, "aa");
        note(knee, 1, "bb");
        assert_eq!(of("aa"), [(hip, Incarnation(1))], "there is room for both");
        note(knee, 2, "bc");
        assert!(of("bb").is_empty());
        assert_eq!(of("bc"), [(knee, Incarnation(2))]);
        note(ankle, 1, "cc");
        assert!(of("aa").is_empty(), "it made room");
        assert_eq!((of("bc").len(), of("cc").len()), (1, 1));
    }
}
