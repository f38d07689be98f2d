//! What the core has to say to layers and applications.

use std::{net::SocketAddr, rc::Rc, time::Duration};

use sinew_runtime::{
    mailbox::About,
    outcome::Rejection,
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::Message,
};

use super::{Shell, lock};
use crate::{
    aftermath,
    ndl::{
        LossReason, MembershipFact, NodeEvent,
        core::{Input, Output},
    },
};

/// Time until a layer whose post was full is offered again what it had no room for.
const RETRY: Duration = Duration::from_millis(10);

impl Shell {
    /// What the core orders next; nothing, if a later instance carries that out.
    pub(super) fn next_order(&self) -> Option<Output> {
        let mut core = lock(&self.stores);
        if !core.is_current(self.epoch) {
            return None;
        }
        // With the lock in hand: where a later instance takes over here, it tells this before what it has to say itself.
        core.poll().inspect(|order| self.stores.untold.note(order))
    }

    /// A life that is over is fenced before anybody hears of that: who does gets no message of it afterwards.
    pub(super) fn tell_layers(&self, fact: &MembershipFact) {
        self.fence(fact);
        if let MembershipFact::NodeLost { node, incarnation, .. } = *fact {
            self.stores.untold.is_fenced(node, incarnation);
        }
        let (MembershipFact::NodeFound { node, .. } | MembershipFact::NodeLost { node, .. }) = fact;
        if let Some(suppressed) = self.stores.log_quotas.members.take(node, Time::now()) {
            self.log(fact, (suppressed > 0).then_some(suppressed));
        }
        self.tell();
    }

    fn log(&self, fact: &MembershipFact, suppressed: Option<u64>) {
        match fact {
            MembershipFact::NodeFound { node, incarnation: life, gncl } => {
                let name = lock(&self.stores).name_of(*node);
                crate::log::info!(%node, %life, ?gncl, suppressed, "node {name} was found");
            }
            MembershipFact::NodeLost { node, incarnation: life, why } => {
                let name = lock(&self.stores).name_of(*node);
                if matches!(why, LossReason::Left) {
                    crate::log::info!(%node, %life, suppressed, "node {name} was lost: {why}");
                } else {
                    crate::log::warn!(%node, %life, suppressed, "node {name} was lost: {why}");
                }
            }
        }
    }

    /// A member listens elsewhere now. It may say so each second, for ever.
    pub(super) fn tell_of_a_move(&self, node: NodeAddress, gncl: &[SocketAddr]) {
        if let Some(suppressed) = self.stores.log_quotas.moves.take(&node, Time::now()) {
            crate::log::info!(%node, ?gncl, suppressed, "the node listens there now");
        }
        self.tell();
    }

    fn fence(&self, fact: &MembershipFact) {
        let (node, incarnation, why) = match fact {
            MembershipFact::NodeLost { node, incarnation, why } => (*node, *incarnation, why),
            // By the thread that says that it leaves: a later goodbye is not taken back by this.
            MembershipFact::NodeFound { node, incarnation, .. } => {
                return self.stores.gncl.stays(*node, *incarnation);
            }
        };
        match why {
            LossReason::Left | LossReason::GaveUp(_) => {
                // What it still sends has its age by its clock, until GNCL forgets it.
                if self.stores.gncl.peer(node).is_none_or(|peer| peer.incarnation != incarnation) {
                    self.stores.clocks.forget(node, incarnation);
                }
                self.stores.gncl.leaves(Time::now(), node, incarnation);
            }
            LossReason::Crashed
            | LossReason::Hung
            | LossReason::LinkDown
            | LossReason::Restarted
            | LossReason::Duplicate => {
                self.stores.clocks.forget(node, incarnation);
                self.stores.gncl.fence(node, incarnation);
            }
        }
    }

    /// Tells other layers what they have not been told yet. Returns whether they have room for all of it.
    pub(super) fn tell(&self) -> bool {
        let told = self.stores.untold.offer(&self.stores.posts, |fact| self.fence(fact));
        let Some(layer) = told else { return true };
        let what = format_args!("{layer} does not read its events: it is told later who is there");
        self.refusals.count(Time::now(), "a layer's post is full", &what);
        self.untold.notify_one();
        false
    }

    pub(super) fn tell_application(&self, app: AppAddress, event: &NodeEvent) {
        let here = self.stores.node;
        let mut message = Message::typed(Tid::new(here, AppAddress::NDL), Tid::new(here, app), event);
        message.header.sent = Time::now();
        let Err(why) = aftermath::tell(&self.stores, about(event), message) else { return };
        let now = Time::now();
        let what = format_args!("{app} does not learn of {event:?}: {why}");
        self.refusals.count(now, "event not taken by an application", &what);
        // Any other refusal says that it is gone, and nobody has to hear of it.
        if why == Rejection::QueueFull {
            lock(&self.stores).handle(now, Input::EventNotTaken { app });
            self.rewind.notify_one();
        }
    }
}

/// Offers other layers again what they had no room for, for as long as there is something.
pub(super) async fn tell_again(shell: Rc<Shell>) {
    loop {
        // A former instance may have left something, too.
        if shell.tell() {
            shell.untold.notified().await;
        }
        tokio::time::sleep(RETRY).await;
    }
}

/// What an event is about: its place among the node's messages depends on it.
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
    use sinew_runtime::tid::Incarnation;

    use super::*;
    use crate::{config::NodeConfig, stores::Stores};

    #[test]
    fn who_is_found_in_the_life_that_was_said_to_leave_has_not_left() {
        // Given: a life that GNCL has a connection with
        let stores = Stores::for_test(NodeConfig::new("hip"), Incarnation(1));
        stores.gncl_listen.get_or_init(|| ([127, 0, 0, 1], 1).into());
        let (shell, _readers) = Shell::bind(stores.clone()).expect("any free port");
        let (node, incarnation, why) = (NodeAddress::new(9), Incarnation(3), LossReason::Left);
        let _peer = stores.gncl.meet_in_test(node, incarnation, &stores);
        let stays = stores.gncl.owed(node);
        // When
        shell.tell_layers(&MembershipFact::NodeLost { node, incarnation, why });
        assert_ne!(stores.gncl.owed(node), stays, "its last messages are waited for");
        let found = |incarnation| MembershipFact::NodeFound { node, incarnation, gncl: Vec::new() };
        shell.tell_layers(&found(Incarnation(4)));
        assert_ne!(stores.gncl.owed(node), stays, "another life is found");
        shell.tell_layers(&found(incarnation));
        // Then
        assert_eq!(stores.gncl.owed(node), stays);
    }

    #[test]
    fn a_node_that_moves_without_end_has_so_many_lines_in_the_log_and_no_more() {
        let stores = Stores::for_test(NodeConfig::new("hip"), Incarnation(1));
        stores.gncl_listen.get_or_init(|| ([127, 0, 0, 1], 1).into());
        let (shell, _readers) = Shell::bind(stores.clone()).expect("any free port");
        let (node, gncl) = (NodeAddress::new(0x0a00_0002), [SocketAddr::from(([10, 0, 0, 2], 5_000))]);
        (0..1_000).for_each(|_| shell.tell_of_a_move(node, &gncl));
        assert_ne!(stores.log_quotas.moves.take(&node, Time::now()), Some(0), "some were left out");
    }
}
