//! The certificate with which each node was last linked. When it is revoked, the incarnation that used it is
//! no longer authenticated.

use std::{collections::BTreeMap, sync::Mutex};

use sinew_runtime::{
    lock,
    tid::{Incarnation, NodeAddress},
};
use sinew_security::Peer;

use crate::State;

/// The proofs of all linked nodes. They outlive links, the other state of a peer, and restarts of this layer:
/// a linked incarnation blocks earlier ones for as long.
#[derive(Default)]
pub(super) struct AuthenticatedNodes(Mutex<BTreeMap<NodeAddress, Authentication>>);

/// The authentication of an incarnation.
struct Authentication {
    incarnation: Incarnation,
    peer: Peer,
}

impl AuthenticatedNodes {
    /// Records that `node` is linked in this incarnation, as `peer`. If there are more than `nodes_max`,
    /// nodes that are no longer `known` are removed.
    pub(super) fn record(
        &self,
        (node, incarnation): (NodeAddress, Incarnation),
        peer: Peer,
        nodes_max: usize,
        known: impl Fn(NodeAddress) -> bool,
    ) {
        let mut all = lock(&self.0);
        all.insert(node, Authentication { incarnation, peer });
        if all.len() > nodes_max {
            all.retain(|node, _| known(*node));
        }
    }

    /// Returns the incarnations that were linked as a peer that satisfies `what`.
    pub(super) fn matching(&self, what: impl Fn(&Peer) -> bool) -> Vec<(NodeAddress, Incarnation)> {
        let all = lock(&self.0);
        let those = all.iter().filter(|(_, proof)| what(&proof.peer));
        those.map(|(node, proof)| (*node, proof.incarnation)).collect()
    }
}

/// Returns the incarnation of this node that was last linked, if nodes authenticate.
pub(crate) fn authenticated_incarnation(state: &State, node: NodeAddress) -> Option<Incarnation> {
    lock(&state.store.authenticated.0).get(&node).map(|proof| proof.incarnation)
}

/// Whether the certificate with which this incarnation was linked is on the deny list.
pub(crate) fn is_revoked(state: &State, node: NodeAddress, incarnation: Incarnation) -> bool {
    let Some(secured) = state.security.secured.get() else { return false };
    state
        .store
        .authenticated
        .matching(|peer| secured.tls.denies(peer).is_some())
        .contains(&(node, incarnation))
}

#[cfg(test)]
mod tests {
    use super::*;
    use sinew_security::{Judged, Validity, testing};

    fn peer(serial: &str) -> Peer {
        Peer {
            identity: testing::identity("hip", 1),
            serial: serial.parse().expect("a number"),
            validity: Validity { from: testing::at(0), until: testing::at(1) },
            times: Judged::Valid,
        }
    }

    #[test]
    fn last_certificate_counts_and_unknown_nodes_make_room() {
        let (nodes, [hip, knee, ankle]) = (AuthenticatedNodes::default(), [1, 2, 3].map(NodeAddress::new));
        let record = |node, incarnation, serial| {
            nodes.record((node, Incarnation(incarnation)), peer(serial), 2, |node| node != hip);
        };
        let of = |serial: &str| nodes.matching(|shown| shown.serial == peer(serial).serial);
        record(hip, 1, "aa");
        record(knee, 1, "bb");
        assert_eq!(of("aa"), [(hip, Incarnation(1))], "there is room for both");
        record(knee, 2, "bc");
        assert!(of("bb").is_empty());
        assert_eq!(of("bc"), [(knee, Incarnation(2))]);
        record(ankle, 1, "cc");
        assert!(of("aa").is_empty(), "it made room");
        assert_eq!((of("bc").len(), of("cc").len()), (1, 1));
    }
}
