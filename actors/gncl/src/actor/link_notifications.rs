//! Link events for the other layers, which wait in order while an event queue is full.

use std::sync::Arc;

use sinew_model::{
    events::{FullQueues, offer_when_room},
    facts::LinkFact,
    notifications::claim_notifications,
};
use sinew_runtime::time::Time;

use super::Gncl;
use crate::State;

impl Gncl {
    pub(super) fn push_fact(&mut self, mut fact: LinkFact) {
        match &mut fact {
            LinkFact::PeerLeft { node, gave_up, .. } => *gave_up = self.leave_reasons.remove(node),
            LinkFact::LinkBroken { node, .. } => _ = self.leave_reasons.remove(node),
            LinkFact::LinkUp { .. } | LinkFact::DialRefused { .. } => {}
        }
        let (node, incarnation) = fact.subject();
        if let Some(suppressed) = self.state.ctx.log_quotas.links.take(&node, Time::now()) {
            sinew_runtime::log::debug!(?fact, suppressed, "link");
        }
        self.state.store.link_status.fact(Time::now(), &fact);
        if matches!(fact, LinkFact::PeerLeft { .. }) {
            self.state.store.record_departure(Time::now(), node, incarnation);
        }
        self.state.link_events.push(fact);
        self.offer_link_events();
    }

    /// Reports the links of a former instance as broken.
    pub(super) fn report_cut_links(&self) {
        let peers = self.state.store.peers();
        let broken =
            peers.iter().map(|peer| LinkFact::LinkBroken { node: peer.node, incarnation: peer.incarnation });
        self.state.link_events.links_are_cut(broken);
        self.offer_link_events();
    }

    fn offer_link_events(&self) {
        if offer(&self.state).layer().is_some() {
            self.state.link_events.has_pending.notify_one();
        }
    }
}

/// Offers pending events to the other layers, until their queues are full.
fn offer(state: &State) -> FullQueues {
    let full = state.link_events.offer(&state.ctx.event_queues);
    if let Some(layer) = full.layer() {
        let what = format_args!("{layer} does not read its events: its link events are delivered later");
        state.store.refusals.count(Time::now(), "a layer's event queue is full", &what);
    }
    full
}

/// Offers pending events as soon as the other layers have room for them.
pub(super) async fn offer_later(state: Arc<State>) {
    claim_notifications(&state.link_events.has_pending);
    offer_when_room(&state.ctx.event_queues, &state.link_events.has_pending, || offer(&state)).await;
}
