//! The execution of the core's outputs.

use bytes::Bytes;
use sinew_model::{
    barrier::BarrierAnswer, directory::DirectoryEvent, events::LayerReport, refusals::PEER_GONE,
    rejections::is_of_an_end,
};
use sinew_runtime::{
    app::RequirementEvent,
    outcome::Rejection,
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{Flags, Header, Kind, Message, Payload},
};

use super::SyncManager;
use crate::{
    core::{Input, Output, Reason},
    discovery,
};

/// Returns the cause under which a frame that was not sent to a peer is counted.
const fn cause_of(why: Rejection) -> &'static str {
    // The peer is being stopped, or is lost: this incarnation needs no further frames.
    if matches!(why, Rejection::Closed | Rejection::NoSuchNode) { PEER_GONE } else { "peer" }
}

impl SyncManager {
    pub(super) fn execute(&self, output: Output) {
        match output {
            Output::Release { app } => {
                sinew_runtime::log::debug!(%app, "all that it requires is ready");
                if self.state.ctx.root.report(LayerReport::Release { app }).is_err() {
                    self.refuse(
                        "root",
                        &"the event queue of the node's root is full: an application is started later",
                    );
                    self.core().handle(Time::now(), Input::ReleaseRejected { app });
                }
            }
            Output::Notify { app, event, why } => self.notify(app, event, why),
            Output::NotifyDirectory { app, event } => self.notify_directory(app, event),
            Output::Publish { to, list } => self.publish(to, list),
            Output::PublishArrivals { to, frame } => self.publish_arrivals(to, frame),
            Output::AnswerBarrier { app, correlation, answer } => self.answer(app, correlation, answer),
            Output::RouteGroups { node, groups } => self.state.ctx.router.set_remote_groups(node, &groups),
            Output::Cycle { names } => self.refuse_cycle(names),
            Output::Overdue(waiting) => sinew_runtime::log::warn!(
                application = waiting.application,
                "{waiting}; it continues to wait. Are these applications started, and spelled right?"
            ),
            Output::Misspelt { application, name, nearest } => {
                let nearest = if nearest.is_empty() {
                    format!("none is similar{}", discovery::in_words(&self.state))
                } else {
                    format!("nearest: {}", nearest.join(", "))
                };
                sinew_runtime::log::warn!(
                    application,
                    "{application} waits for `{name}`, which no application is called; {nearest}. Is it spelled right, and its node started?"
                );
            }
            Output::SameName { name, tids } => sinew_runtime::log::warn!(
                name,
                ?tids,
                "several nodes have an application of this name; it resolves to the first of these"
            ),
            Output::Refused { cause, detail } => self.refuse(cause, &detail),
        }
    }

    /// Notifies a subscribed application of a change of a requirement, and logs the change.
    fn notify(&self, app: AppAddress, event: RequirementEvent, why: Option<Reason>) {
        let title = self.title_of(app);
        let words = why.map_or("it is ready again by now", Reason::words);
        match &event {
            RequirementEvent::Lost { name } if why.is_some_and(Reason::is_orderly) => {
                sinew_runtime::log::info!(%app, "{title} lost {name}, which it requires: {words}");
            }
            RequirementEvent::Lost { name } => {
                sinew_runtime::log::warn!(%app, "{title} lost {name}, which it requires: {words}");
            }
            RequirementEvent::Without { name } => {
                sinew_runtime::log::warn!(%app, "{title} goes on without {name}, which it can do without: {words}");
            }
            RequirementEvent::Met { name } => {
                sinew_runtime::log::info!(%app, "{name}, which {title} requires, is ready again");
            }
        }
        if !self.state.ctx.router.subscribes(app, RequirementEvent::KIND) {
            return;
        }
        let here = self.state.ctx.node;
        let mut message = Message::typed(self.tid(), Tid::new(here, app), &event);
        self.stamp(&mut message.header);
        match self.state.ctx.offer_event(message) {
            Ok(()) => {}
            Err(Rejection::QueueFull) => {
                self.refuse(
                    "mailbox",
                    &format_args!(
                        "the mailbox of {app} is full; the requirement event is sent as soon as it has room"
                    ),
                );
                let name = event.name().to_owned();
                self.core().handle(Time::now(), Input::EventRejected { app, name });
            }
            // The application has ended. This is usual while a whole robot stops.
            Err(why) if is_of_an_end(why) => {}
            Err(why) => {
                self.refuse("application", &format_args!("a requirement event was not sent to {app}: {why}"))
            }
        }
    }

    /// Sends a change of the directory to an application.
    fn notify_directory(&self, app: AppAddress, event: DirectoryEvent) {
        let mut message = Message::typed(self.tid(), Tid::new(self.state.ctx.node, app), &event);
        self.stamp(&mut message.header);
        // Any other rejection means that the application has ended.
        if let Err(Rejection::QueueFull) = self.state.ctx.offer_event(message) {
            self.core().handle(Time::now(), Input::DirectoryRejected { app, event });
        }
    }

    /// Sends the list. A rejected list is sent again in 10 ms.
    fn publish(&self, to: NodeAddress, list: Bytes) {
        let mut header = Header::new(Kind::SYNC_DIRECTORY, self.tid(), Tid::new(to, AppAddress::SYNC));
        self.stamp(&mut header);
        let sent = self.state.ctx.router.send(Message::new(header, list));
        if sent.is_ok() {
            let listed = self.core().listed_groups();
            self.state.ctx.router.groups_listed(to, &listed);
        }
        if let Err(why) = sent {
            self.refuse(
                cause_of(why),
                &format_args!("this node's directory was not sent to {to}, tried again: {why}"),
            );
            // A retry does not help if the peer accepts only shorter frames than this node writes.
            if why != Rejection::TooLong {
                self.core().handle(Time::now(), Input::ListRejected { to });
            }
        }
    }

    /// Sends the barrier state. Applications wait for it: a rejected frame is sent again in 10 ms.
    fn publish_arrivals(&self, to: NodeAddress, frame: Bytes) {
        let mut header = Header::new(Kind::SYNC_ARRIVALS, self.tid(), Tid::new(to, AppAddress::SYNC));
        self.stamp(&mut header);
        if let Err(why) = self.state.ctx.router.send(Message::new(header, frame)) {
            self.refuse(
                cause_of(why),
                &format_args!("this node's barrier state was not sent to {to}, tried again: {why}"),
            );
            // A retry does not help if the peer accepts only shorter frames than this node writes.
            if why != Rejection::TooLong {
                self.core().handle(Time::now(), Input::ArrivalsRejected { to });
            }
        }
    }

    fn answer(&self, app: AppAddress, correlation: u64, answer: BarrierAnswer) {
        let mut message = Message::typed(self.tid(), Tid::new(self.state.ctx.node, app), &answer);
        self.stamp(&mut message.header);
        message.header.flags = Flags::REPLY;
        message.header.correlation = correlation;
        let Err(why) = self.state.ctx.router.send(message) else { return };
        self.refuse("application", &format_args!("the barrier answer was not sent to {app}: {why}"));
        // Any other rejection means that the application has ended.
        if why == Rejection::QueueFull {
            self.core().handle(Time::now(), Input::AnswerRejected { app, correlation, answer });
        }
    }

    fn refuse_cycle(&self, names: Vec<String>) {
        let labels: Vec<String> = names.iter().map(|name| self.with_node(name)).collect();
        let spelled = labels.join(" requires ");
        sinew_runtime::log::error!(
            "these applications require each other in a circle, so that none of them can ever start: {spelled}; \
             remove one of these requirements"
        );
        if self.state.ctx.root.report(LayerReport::RequirementCycle { names, labels }).is_err() {
            self.refuse(
                "root",
                &"the event queue of the node's root is full: a cycle of requirements is not reported",
            );
        }
    }

    fn title_of(&self, app: AppAddress) -> String {
        let applications = self.state.ctx.ports.applications();
        applications.map_or_else(|| app.to_string(), |applications| applications.title_of(app))
    }

    /// Returns the name, with the name of its node if that is another one.
    fn with_node(&self, name: &str) -> String {
        let tid = self.core().called(name).first().copied();
        let Some(node) = tid.map(|tid| tid.node).filter(|node| *node != self.state.ctx.node) else {
            return name.to_owned();
        };
        // The locks of NDL and of this core are never held together.
        let members = self.state.ctx.ports.members().map_or_else(Vec::new, |members| members.present());
        let called = members.into_iter().find(|member| member.node == node).map(|member| member.name);
        format!("{name} (node {})", called.unwrap_or_else(|| node.to_string()))
    }

    fn tid(&self) -> Tid {
        Tid::new(self.state.ctx.node, AppAddress::SYNC)
    }

    fn stamp(&self, header: &mut Header) {
        header.sequence = self.core().next_sequence();
        header.sent = Time::now();
    }
}
