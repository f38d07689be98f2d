//! Delivers the core's facts and events to layers and applications.

use std::{net::SocketAddr, rc::Rc};

use sinew_model::{
    events::{FullQueues, offer_when_room},
    facts::{AppFact, LossReason, MembershipFact, NodeEvent},
    notifications::claim_notifications,
};
use sinew_runtime::{
    mailbox::About,
    outcome::Rejection,
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::Message,
};

use super::{Shell, lock_core};
use crate::{State, core::Output};

impl Shell {
    /// Returns the next output of the core, or `None` if a later instance is responsible for it.
    pub(super) fn next_output(&self) -> Option<Output> {
        let mut core = lock_core(&self.state);
        if !core.is_current(self.epoch) {
            return None;
        }
        // Done with the lock held: a later instance that takes over here delivers this fact before its own ones.
        core.poll().inspect(|output| self.state.member_events.push(output))
    }

    /// Fences an ended incarnation before its loss is reported. A receiver of the report gets no message of
    /// that incarnation afterwards.
    pub(super) fn report_fact(&self, fact: &MembershipFact) {
        self.fence(fact);
        if let MembershipFact::NodeLost { node, incarnation, .. } = *fact {
            self.state.member_events.set_fenced(node, incarnation);
        }
        let (MembershipFact::NodeFound { node, .. } | MembershipFact::NodeLost { node, .. }) = fact;
        if let Some(suppressed) = self.state.ctx.log_quotas.members.take(node, Time::now()) {
            self.log(fact, (suppressed > 0).then_some(suppressed));
        }
        self.offer_to_layers();
    }

    fn log(&self, fact: &MembershipFact, suppressed: Option<u64>) {
        match fact {
            MembershipFact::NodeFound { node, incarnation: life, gncl } => {
                let name = lock_core(&self.state).name_of(*node);
                sinew_runtime::log::info!(%node, %life, ?gncl, suppressed, "node {name} was found");
            }
            MembershipFact::NodeLost { node, incarnation: life, why } => {
                let name = lock_core(&self.state).name_of(*node);
                if matches!(why, LossReason::Left) {
                    sinew_runtime::log::info!(%node, %life, suppressed, "node {name} was lost: {why}");
                } else {
                    sinew_runtime::log::warn!(%node, %life, suppressed, "node {name} was lost: {why}");
                }
            }
        }
    }

    /// Logs that a member listens at other addresses now. A member may cause this each second, without end,
    /// so a quota limits it.
    pub(super) fn report_move(&self, node: NodeAddress, gncl: &[SocketAddr]) {
        if let Some(suppressed) = self.state.ctx.log_quotas.moves.take(&node, Time::now()) {
            sinew_runtime::log::info!(%node, ?gncl, suppressed, "the node listens there now");
        }
        self.offer_to_layers();
    }

    fn fence(&self, fact: &MembershipFact) {
        let links = self.state.ctx.ports.links();
        let (life, why) = match fact {
            MembershipFact::NodeLost { node, incarnation, why } => ((*node, *incarnation), why),
            // GNCL is notified by the thread that notifies it of leaves, so a later leave is not reverted by this.
            MembershipFact::NodeFound { node, incarnation, .. } => {
                return links.iter().for_each(|links| links.revoke_departure((*node, *incarnation)));
            }
        };
        let (node, incarnation) = life;
        let leaves = matches!(why, LossReason::Left | LossReason::GaveUp(_));
        // Messages that a leaving peer still sends have their age computed by its clock, until GNCL forgets it.
        let still_sends =
            leaves && links.as_ref().is_some_and(|links| links.incarnation(node) == Some(incarnation));
        if !still_sends {
            self.state.ctx.clocks.forget(node, incarnation);
        }
        let Some(links) = links else { return };
        if leaves {
            links.record_departure(Time::now(), life);
        } else {
            links.fence(life);
        }
    }

    /// Offers pending events to other layers.
    pub(super) fn offer_to_layers(&self) {
        if self.offer_member_events().layer().is_some() {
            self.has_pending.notify_one();
        }
    }

    fn offer_member_events(&self) -> FullQueues {
        let full = self.state.member_events.offer(&self.state.ctx.event_queues, |fact| self.fence(fact));
        if let Some(layer) = full.layer() {
            let what = format_args!("{layer} does not read its events: it is told later who is there");
            self.refusals.count(Time::now(), "a layer's event queue is full", &what);
        }
        full
    }

    /// Notifies an application, at once or as soon as its mailbox has room.
    pub(super) fn notify_application(&self, app: AppAddress, event: NodeEvent) {
        let notified = self.state.node_events.notify(app, event, |event| {
            self.offer_event(app, event).inspect_err(|why| {
                let what = format_args!("{app} rejected {event:?}: {why}");
                self.refusals.count(Time::now(), "event not taken by an application", &what);
            })
        });
        if notified == Ok(true) {
            let what = format_args!("{app} reads nothing, and too many events are pending for it");
            self.refusals.count(Time::now(), "more events than are kept for an application", &what);
        }
    }

    fn offer_event(&self, app: AppAddress, event: &NodeEvent) -> Result<(), Rejection> {
        let here = self.state.ctx.node;
        let mut message = Message::typed(Tid::new(here, AppAddress::NDL), Tid::new(here, app), event);
        message.header.sent = Time::now();
        match self.state.ctx.ports.links() {
            Some(links) => links.notify_after_messages(about(event), message),
            None => self.state.ctx.offer_event(message),
        }
    }
}

/// Drops the pending events for an ended incarnation of an application: they are not for its successor.
pub(super) fn forget_events(state: &State, fact: &AppFact) {
    if let AppFact::Ready { app }
    | AppFact::Down { app }
    | AppFact::Stopped { app }
    | AppFact::Unregistered { app } = fact
    {
        state.node_events.forget(*app);
    }
}

/// Offers pending events to applications as soon as they have room for them.
pub(super) async fn deliver_node_events(shell: Rc<Shell>) {
    let has_room = &shell.state.ctx.room_notifier.node_events;
    claim_notifications(has_room);
    loop {
        shell.state.node_events.offer(|app, event| shell.offer_event(app, event));
        has_room.notified().await;
        // Repeated notifications must not block other tasks.
        tokio::task::yield_now().await;
    }
}

/// Offers pending events to other layers as soon as they have room for them.
pub(super) async fn offer_later(shell: Rc<Shell>) {
    offer_when_room(&shell.state.ctx.event_queues, &shell.has_pending, || shell.offer_member_events()).await;
}

/// Returns the subject of an event, which determines its order among the node's messages.
const fn about(event: &NodeEvent) -> About {
    match event {
        NodeEvent::NodeLost { node, .. } | NodeEvent::NodeRestarted { node, .. } => About::End(*node),
        NodeEvent::NodeFound { node, .. }
        | NodeEvent::AppStalled { node, .. }
        | NodeEvent::AppResumed { node, .. } => About::Node(*node),
    }
}

#[cfg(test)]
mod tests {
    use std::sync::Arc;

    use sinew_model::{config::NodeConfig, ports::testing::PlayedLinks};
    use sinew_runtime::{lock, tid::Incarnation};

    use super::*;
    use crate::State;

    #[test]
    fn node_found_in_its_leaving_incarnation_has_not_left() {
        // Given: an incarnation with a GNCL connection
        let state = State::for_test(NodeConfig::new("hip"), Incarnation(1));
        state.ctx.listens.first.get_or_init(|| ([127, 0, 0, 1], 1).into());
        let (shell, _readers) = Shell::bind(state.clone()).expect("any free port");
        let (node, incarnation, why) = (NodeAddress::new(9), Incarnation(3), LossReason::Left);
        let links = Arc::new(PlayedLinks::default());
        state.ctx.ports.connect_links(&(links.clone() as Arc<_>));
        // When
        shell.report_fact(&MembershipFact::NodeLost { node, incarnation, why });
        assert_eq!(lock(&links.left)[..], [(node, incarnation)], "its last messages are pending");
        let found = |incarnation| MembershipFact::NodeFound { node, incarnation, gncl: Vec::new() };
        shell.report_fact(&found(Incarnation(4)));
        assert_eq!(lock(&links.left)[..], [(node, incarnation)], "another incarnation is found");
        shell.report_fact(&found(incarnation));
        // Then
        assert_eq!(lock(&links.left)[..], []);
    }

    #[test]
    fn log_lines_of_an_endlessly_moving_node_are_bounded() {
        let state = State::for_test(NodeConfig::new("hip"), Incarnation(1));
        state.ctx.listens.first.get_or_init(|| ([127, 0, 0, 1], 1).into());
        let (shell, _readers) = Shell::bind(state.clone()).expect("any free port");
        let (node, gncl) = (NodeAddress::new(0x0a00_0002), [SocketAddr::from(([10, 0, 0, 2], 5_000))]);
        (0..1_000).for_each(|_| shell.report_move(node, &gncl));
        assert_ne!(state.ctx.log_quotas.moves.take(&node, Time::now()), Some(0), "some were left out");
    }
}
