//! What the core has to say to layers and applications.

use sinew_runtime::{
    mailbox::About,
    outcome::Rejection,
    tid::{AppAddress, Tid},
    time::Time,
    wire::Message,
};

use super::{Shell, lock};
use crate::{
    aftermath, gncl,
    ndl::{LossReason, MembershipFact, NodeEvent, core::Input},
    sync,
};

impl Shell {
    /// A life that is over is fenced before anybody hears of that: who does gets no message of it afterwards.
    pub(super) fn tell_layers(&self, fact: MembershipFact) {
        if let MembershipFact::NodeLost { node, incarnation, why } = fact {
            self.stores.clocks.forget(node);
            match why {
                LossReason::Left => self.stores.gncl.leaves(Time::now(), node, incarnation),
                LossReason::Crashed
                | LossReason::Hung
                | LossReason::LinkDown
                | LossReason::Restarted
                | LossReason::Duplicate => self.stores.gncl.fence(node, incarnation),
            }
        }
        crate::log::info!(?fact, "membership");
        let posts = &self.stores.posts;
        self.tell_gncl(gncl::Event::Membership(fact.clone()));
        if let Err(event) = posts.sync.post(sync::Event::Membership(fact)) {
            crate::log::error!(?event, "the sync manager's post is full: it does not learn this");
        }
    }

    pub(super) fn tell_gncl(&self, event: gncl::Event) {
        if let Err(event) = self.stores.posts.gncl.post(event) {
            crate::log::error!(?event, "GNCL's post is full: it does not learn this");
        }
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

/// What an event is about: its place among the node's messages depends on it.
const fn about(event: &NodeEvent) -> About {
    match event {
        NodeEvent::NodeLost { node, .. } | NodeEvent::NodeRestarted { node, .. } => About::End(*node),
        NodeEvent::NodeFound { node, .. }
        | NodeEvent::AppStalled { node, .. }
        | NodeEvent::AppResumed { node, .. } => About::Node(*node),
    }
}
