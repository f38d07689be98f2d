//! What other layers ask GNCL.

use std::{collections::BTreeSet, pin::Pin, sync::Arc};

use sinew_model::{
    ports::{Links, NodeIncarnation},
    undelivered::Report,
};
use sinew_runtime::{
    mailbox::About,
    outcome::Rejection,
    tid::{Incarnation, NodeAddress},
    time::Time,
    wire::Message,
};

use super::{Peer, State, authenticated, node_down_events};

impl Links for State {
    fn connected(&self) -> BTreeSet<NodeIncarnation> {
        // The first session is the one for Control, and GNCL reports its connection.
        let stands =
            |peer: &Peer| peer.sessions().first().is_some_and(|session| session.outlet.is_connected());
        let peers = self.store.peers();
        peers.iter().filter(|peer| stands(peer)).map(|peer| (peer.node, peer.incarnation)).collect()
    }

    fn incarnation(&self, node: NodeAddress) -> Option<Incarnation> {
        self.store.peer(node).map(|peer| peer.incarnation)
    }

    fn request_liveness(&self, (node, incarnation): NodeIncarnation) {
        self.store.request_liveness(self.ctx.node, node, incarnation);
    }

    fn last_alive(&self, (node, incarnation): NodeIncarnation) -> Option<Time> {
        self.store.last_alive(node, incarnation)
    }

    fn revoke_departure(&self, (node, incarnation): NodeIncarnation) {
        self.store.revoke_departure(node, incarnation);
    }

    fn record_departure(&self, now: Time, (node, incarnation): NodeIncarnation) {
        self.store.record_departure(now, node, incarnation);
    }

    fn fence(&self, (node, incarnation): NodeIncarnation) {
        self.store.fence(node, incarnation);
    }

    fn notify_after_messages(&self, about: About, event: Message) -> Result<(), Rejection> {
        node_down_events::notify(self, about, event)
    }

    fn deliver_held_events(self: Arc<Self>) -> Pin<Box<dyn Future<Output = ()>>> {
        Box::pin(node_down_events::run_retries(self))
    }

    fn authenticated_incarnation(&self, node: NodeAddress) -> Option<Incarnation> {
        authenticated::authenticated_incarnation(self, node)
    }

    fn is_revoked(&self, (node, incarnation): NodeIncarnation) -> bool {
        authenticated::is_revoked(self, node, incarnation)
    }

    fn report_undelivered(&self, node: NodeAddress, report: &Report) {
        if let Some(peer) = self.store.peer(node) {
            peer.report_undelivered(self.ctx.node, report);
        }
    }
}
