//! The sync manager's shell: carries facts into its core and orders out of it.

use std::sync::{Arc, MutexGuard, PoisonError};

use actix::{Actor, ActorContext, AsyncContext, Context, SpawnHandle, StreamHandler};
use bytes::Bytes;
use sinew_runtime::{
    app::RequirementEvent,
    outcome::{Outcome, Rejection},
    post::Post,
    router::{LocalRoute, Outlet, Refused},
    supervision::ReadyGate,
    tid::{AppAddress, NodeAddress, Tid},
    time::Time,
    wire::{Flags, Header, Kind, Message, Payload},
};

use super::{
    Event,
    core::{Core, Input, Named, Output, Place, Reason},
    discovery,
    facts::DirectoryEvent,
    list::Published,
    words::{ArriveAtBarrier, BarrierAnswer, LeaveBarrier},
};
use crate::{
    audit, gncl,
    lncl::AppFact,
    monitors,
    ndl::MembershipFact,
    node::RootEvent,
    refusals::{PEER_GONE, Refusals},
    stores::{self, POST_CAPACITY, Stores},
    undelivered, wills,
};

/// The sync manager of a node: a new one after each fault, on the same core.
pub(crate) struct SyncManager {
    stores: Arc<Stores>,
    ready: Option<ReadyGate>,
    refusals: Arc<Refusals>,
    /// The event in hand, and how many inputs have come of it; `None`: the time has come for something.
    in_hand: Option<Place>,
    /// The timer that is set, and for when.
    alarm: Option<(Time, SpawnHandle)>,
}

/// The cause under which a frame is counted that a peer was not sent.
const fn cause_of(why: Rejection) -> &'static str {
    // It is being stopped, or has been lost: this life of it needs to know nothing more.
    if matches!(why, Rejection::Closed | Rejection::NoSuchNode) { PEER_GONE } else { "peer" }
}

impl SyncManager {
    /// A sync manager on the core in `stores`; it opens `ready` when messages reach it.
    pub(crate) fn new(stores: Arc<Stores>, ready: ReadyGate) -> Self {
        let refusals = stores.refusals.clone();
        Self { stores, ready: Some(ready), refusals, in_hand: None, alarm: None }
    }
}

impl Actor for SyncManager {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.add_stream(self.stores.posts.sync.attach_keeping(Event::copy).numbered());
        let outlet = Arc::new(PostOutlet(self.stores.posts.sync.clone()));
        self.stores.router.set_local(AppAddress::SYNC, LocalRoute { outlet, events: Arc::new([]) });
        // A predecessor may have failed between two of the core's orders, or before it heard of the groups.
        self.core().replaced(Time::now());
        self.stores.groups_are_looked_at();
        self.take_groups();
        monitors::feed(&self.stores, monitors::Input::TimePassed);
        wills::feed(&self.stores, wills::Input::TimePassed);
        self.handle(Input::TimePassed, ctx);
        self.make_up();
        if let Some(ready) = self.ready.take() {
            ready.reached();
        }
    }
}

impl StreamHandler<(u64, Event)> for SyncManager {
    fn handle(&mut self, (number, event): (u64, Event), ctx: &mut Self::Context) {
        self.in_hand = Some((number, 0));
        self.take(event, ctx);
        self.in_hand = None;
    }

    /// The post has another reader: this actor was replaced.
    fn finished(&mut self, ctx: &mut Self::Context) {
        ctx.stop();
    }
}

impl SyncManager {
    fn take(&mut self, event: Event, ctx: &mut Context<Self>) {
        match event {
            Event::App(fact) => {
                if matches!(fact, AppFact::GroupsChanged) {
                    self.stores.groups_are_looked_at();
                }
                // Who goes leaves its groups, too.
                let groups_may_differ = matches!(fact, AppFact::GroupsChanged | AppFact::Unregistered { .. });
                if groups_may_differ {
                    self.take_groups();
                }
                let ready = if let AppFact::Ready { app } = fact { Some(app) } else { None };
                self.handle(Input::AppChanged(fact), ctx);
                if let Some(app) =
                    ready.filter(|app| self.stores.router.subscribes(*app, DirectoryEvent::KIND))
                {
                    self.handle(Input::DirectoryWanted { app }, ctx);
                }
            }
            Event::Membership(fact) => {
                monitors::feed(&self.stores, (&fact).into());
                if let MembershipFact::NodeLost { node, incarnation, .. } = fact
                    && gncl::is_revoked(&self.stores, node, incarnation)
                {
                    // GNCL may not have read the list yet that is in force.
                    wills::revoke(&self.stores, node, incarnation);
                }
                if let Some(input) = wills::Input::of_membership(&fact) {
                    wills::feed(&self.stores, input);
                }
                self.handle(Input::MembershipChanged(fact), ctx);
            }
            Event::Link(fact) => {
                if let Some(input) = monitors::Input::of_link(&fact) {
                    monitors::feed(&self.stores, input);
                }
                if let Some(input) = wills::Input::of_link(&fact) {
                    wills::feed(&self.stores, input);
                }
                self.handle(Input::LinkChanged(fact), ctx);
            }
            Event::Monitors => {
                monitors::drain(&self.stores);
                self.set_alarm(ctx);
            }
            Event::Message(message) => self.receive(message, ctx),
        }
        self.make_up();
    }

    /// What found the post full waits for this actor to read on: there is room for it, or for some of it, now.
    fn make_up(&self) {
        self.stores.untold_of_apps.offer_to_sync(&self.stores.posts);
        if monitors::has_orders(&self.stores) {
            monitors::drain(&self.stores);
        }
    }

    fn core(&self) -> MutexGuard<'_, Core> {
        self.stores.sync.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn take_groups(&self) {
        // First who is a guest: of who comes between, and joins, this actor is told again.
        let guests = self.stores.access.get().map(|access| access.guests()).unwrap_or_default();
        let published = Published::of(self.stores.router.groups_with_members(), &guests);
        if let Some(left_out) = published.left_out() {
            self.refuse("directory full", &left_out);
        }
        let (mut core, now) = (self.core(), Time::now());
        core.woken(now, self.stores.posts.sync.len());
        core.handle(now, Input::GroupsChanged(published));
    }

    fn handle(&mut self, input: Input, ctx: &mut Context<Self>) {
        self.in_hand = self.in_hand.map(|(event, inputs)| (event, inputs + 1));
        let place = self.in_hand;
        {
            let mut core = self.core();
            let (named, now) = (input.may_name(), Time::now());
            core.woken(now, self.stores.posts.sync.len());
            match place {
                Some(place) => core.handle_once(now, place, input),
                None => core.handle(now, input),
            }
            self.tell_access(&core, named);
            // Counted before anybody can see it: who is told of a name by whoever saw it first must find that it has changed.
            if core.take_directory_changed() {
                self.stores.directory_has_changed();
            }
        }
        // One at a time, and never with the lock in hand: an order may lead to a question to the directory.
        loop {
            let Some(output) = self.core().poll() else { break };
            self.carry_out(output);
        }
        self.set_alarm(ctx);
    }

    /// Has the access list know who is called how elsewhere, before anybody is told of them: what they send is judged by these names.
    fn tell_access(&self, core: &Core, named: Named) {
        let Some(access) = self.stores.access.get() else { return };
        match named {
            Named::Nobody => {}
            Named::By(node) => access.named_elsewhere(Some(node), core.names_elsewhere(Some(node))),
            Named::Anybody => access.named_elsewhere(None, core.names_elsewhere(None)),
        }
    }

    /// Takes a peer's list; anything else that is sent here is refused.
    fn receive(&mut self, mut message: Message, ctx: &mut Context<Self>) {
        let Tid { node, app } = message.header.source;
        if matches!(message.header.kind, ArriveAtBarrier::KIND | LeaveBarrier::KIND) {
            return self.take_word(message, ctx);
        }
        let is_about_lives =
            matches!(message.header.kind, Kind::SYNC_WATCH | Kind::SYNC_LIVES | Kind::SYNC_WILLS);
        let is_audit = matches!(message.header.kind, Kind::SYNC_AUDIT_ASK | Kind::SYNC_AUDIT);
        if !matches!(message.header.kind, Kind::SYNC_DIRECTORY | Kind::SYNC_ARRIVALS)
            && !is_about_lives
            && !is_audit
        {
            let kind = message.header.kind;
            self.refuse(
                "kind",
                &format_args!("{node}/{app} sent kind {kind}; a sync manager takes directories"),
            );
            message.reject(Rejection::UnknownKind);
        } else if app != AppAddress::SYNC || node == self.stores.node {
            self.refuse("source", &format_args!("{node}/{app} is no other node's sync manager"));
            message.reject(Rejection::ForgedSource);
        } else if is_audit {
            if let Err(fault) = audit::receive(&self.stores, node, &message) {
                self.refuse("audit", &fault);
            }
            message.settle(Outcome::Delivered);
        } else if is_about_lives {
            let received = if message.header.kind == Kind::SYNC_WILLS {
                wills::receive(&self.stores, node, &message)
            } else {
                monitors::receive(&self.stores, node, &message)
            };
            if let Err(fault) = received {
                self.refuse("lives", &fault);
            }
            message.settle(Outcome::Delivered);
        } else {
            let payload = message.payload.clone();
            let input = if message.header.kind == Kind::SYNC_ARRIVALS {
                Input::ArrivalsReceived { from: node, payload }
            } else {
                Input::ListReceived { from: node, payload }
            };
            self.handle(input, ctx);
            message.settle(Outcome::Delivered);
        }
    }

    /// Takes what an application of this node says about a barrier. spec: SYNC-10
    fn take_word(&mut self, mut message: Message, ctx: &mut Context<Self>) {
        let Tid { node, app } = message.header.source;
        let is_arrival = message.header.kind == ArriveAtBarrier::KIND;
        if node != self.stores.node {
            self.refuse("barrier", &format_args!("{node}/{app} waits at barriers by its own node"));
            return message.reject(Rejection::ForgedSource);
        }
        if is_arrival && !message.header.flags.has(Flags::ASK) {
            return message.reject(Rejection::Unsupported);
        }
        let correlation = message.header.correlation;
        let input = if is_arrival {
            message.decode().map(|asked| Input::Arrived { app, correlation, asked })
        } else {
            let left = |LeaveBarrier { barrier, correlation }| Input::Left { app, barrier, correlation };
            message.decode().map(left)
        };
        match input {
            Ok(input) => {
                self.handle(input, ctx);
                message.settle(Outcome::Delivered);
            }
            Err(fault) => {
                self.refuse("barrier", &format_args!("{app}: {fault}"));
                message.reject(Rejection::Malformed);
            }
        }
    }

    fn refuse(&self, cause: &'static str, detail: &dyn std::fmt::Display) {
        self.refusals.count(Time::now(), cause, detail);
    }

    fn set_alarm(&mut self, ctx: &mut Context<Self>) {
        let monitors = monitors::next_wake(&self.stores);
        let wills = wills::next_wake(&self.stores);
        let wake = [self.core().next_wake(), monitors, wills].into_iter().flatten().min();
        if self.alarm.as_ref().map(|(at, _)| *at) == wake {
            return;
        }
        if let Some((_, former)) = self.alarm.take() {
            ctx.cancel_future(former);
        }
        self.alarm = wake.map(|at| {
            let timer = ctx.run_later(at.since(Time::now()), |manager, ctx| {
                manager.alarm = None;
                monitors::feed(&manager.stores, monitors::Input::TimePassed);
                wills::feed(&manager.stores, wills::Input::TimePassed);
                manager.handle(Input::TimePassed, ctx);
            });
            (at, timer)
        });
    }
}

/// The core's orders.
impl SyncManager {
    fn carry_out(&self, output: Output) {
        match output {
            Output::Release { app } => {
                crate::log::debug!(%app, "all that it requires is ready");
                if self.stores.posts.root.post(RootEvent::Release { app }).is_err() {
                    self.refuse("root", &"the node's root is too busy to start an application; tried again");
                    self.core().handle(Time::now(), Input::ReleaseNotTaken { app });
                }
            }
            Output::Tell { app, event, why } => self.tell(app, event, why),
            Output::TellDirectory { app, event } => self.tell_of_directory(app, event),
            Output::Publish { to, list } => self.publish(to, list),
            Output::PublishArrivals { to, said } => self.publish_arrivals(to, said),
            Output::AnswerBarrier { app, correlation, answer } => self.answer(app, correlation, answer),
            Output::RouteGroups { node, groups } => self.stores.router.set_remote_groups(node, &groups),
            Output::Cycle { names } => self.refuse_cycle(names),
            Output::Overdue(waiting) => crate::log::warn!(
                application = waiting.application,
                "{waiting}; it goes on waiting. Are these applications started, and spelled right?"
            ),
            Output::Misspelt { application, name, nearest } => {
                let nearest = if nearest.is_empty() {
                    format!("none is similar{}", discovery::in_words(&self.stores))
                } else {
                    format!("nearest: {}", nearest.join(", "))
                };
                crate::log::warn!(
                    application,
                    "{application} waits for `{name}`, which no application is called; {nearest}. Is it spelled right, and its node started?"
                );
            }
            Output::SameName { name, tids } => crate::log::warn!(
                name,
                ?tids,
                "several nodes have an application of this name; whoever asks for the name gets the first of these"
            ),
            Output::Refused { cause, detail } => self.refuse(cause, &detail),
        }
    }

    /// Tells an application that subscribed to it what became of a requirement.
    fn tell(&self, app: AppAddress, event: RequirementEvent, why: Option<Reason>) {
        let title = stores::lock(&self.stores.registry).name_of(app);
        let words = why.map_or("it is ready again by now", Reason::words);
        match &event {
            RequirementEvent::Lost { name } if why.is_some_and(Reason::is_orderly) => {
                crate::log::info!(%app, "{title} lost {name}, which it requires: {words}");
            }
            RequirementEvent::Lost { name } => {
                crate::log::warn!(%app, "{title} lost {name}, which it requires: {words}");
            }
            RequirementEvent::Without { name } => {
                crate::log::warn!(%app, "{title} goes on without {name}, which it can do without: {words}");
            }
            RequirementEvent::Met { name } => {
                crate::log::info!(%app, "{name}, which {title} requires, is ready again");
            }
        }
        if !self.stores.router.subscribes(app, RequirementEvent::KIND) {
            return;
        }
        let here = self.stores.node;
        let mut message = Message::typed(self.tid(), Tid::new(here, app), &event);
        self.stamp(&mut message.header);
        match self.stores.router.send(message) {
            Ok(()) => {}
            Err(Rejection::QueueFull) => {
                self.refuse(
                    "mailbox",
                    &format_args!("{app} is too busy to hear of a requirement; tried again"),
                );
                let name = event.name().to_owned();
                self.core().handle(Time::now(), Input::EventNotTaken { app, name });
            }
            // It has ended itself: an ordinary stop of a whole robot has such.
            Err(why) if undelivered::is_of_an_end(why) => {}
            Err(why) => {
                self.refuse("application", &format_args!("{app} was not told of a requirement: {why}"))
            }
        }
    }

    /// Tells an application what has changed in the directory.
    fn tell_of_directory(&self, app: AppAddress, event: DirectoryEvent) {
        let mut message = Message::typed(self.tid(), Tid::new(self.stores.node, app), &event);
        self.stamp(&mut message.header);
        // Any other refusal says that it is gone, and nobody has to hear of it.
        if let Err(Rejection::QueueFull) = self.stores.router.send(message) {
            self.core().handle(Time::now(), Input::DirectoryNotTaken { app, event });
        }
    }

    /// Sends the list; what the queue does not take is said again in 10 ms.
    fn publish(&self, to: NodeAddress, list: Bytes) {
        let mut header = Header::new(Kind::SYNC_DIRECTORY, self.tid(), Tid::new(to, AppAddress::SYNC));
        self.stamp(&mut header);
        if let Err(why) = self.stores.router.send(Message::new(header, list)) {
            self.refuse(
                cause_of(why),
                &format_args!("{to} was not sent this node's directory, tried again: {why}"),
            );
            // One that takes shorter words than this node writes is not helped by haste.
            if why != Rejection::TooLong {
                self.core().handle(Time::now(), Input::ListNotTaken { to });
            }
        }
    }

    /// Says who waits at barriers. They wait for it: what the queue does not take is said again in 10 ms.
    fn publish_arrivals(&self, to: NodeAddress, said: Bytes) {
        let mut header = Header::new(Kind::SYNC_ARRIVALS, self.tid(), Tid::new(to, AppAddress::SYNC));
        self.stamp(&mut header);
        if let Err(why) = self.stores.router.send(Message::new(header, said)) {
            self.refuse(
                cause_of(why),
                &format_args!("{to} was not told who waits at barriers, tried again: {why}"),
            );
            // One that takes shorter words than this node writes is not helped by haste.
            if why != Rejection::TooLong {
                self.core().handle(Time::now(), Input::ArrivalsNotTaken { to });
            }
        }
    }

    fn answer(&self, app: AppAddress, correlation: u64, answer: BarrierAnswer) {
        let mut message = Message::typed(self.tid(), Tid::new(self.stores.node, app), &answer);
        self.stamp(&mut message.header);
        message.header.flags = Flags::REPLY;
        message.header.correlation = correlation;
        let Err(why) = self.stores.router.send(message) else { return };
        self.refuse("application", &format_args!("{app} was not told what became of its barrier: {why}"));
        // Any other refusal says that it is gone.
        if why == Rejection::QueueFull {
            self.core().handle(Time::now(), Input::AnswerNotTaken { app, correlation, answer });
        }
    }

    fn refuse_cycle(&self, names: Vec<String>) {
        let labels: Vec<String> = names.iter().map(|name| self.with_node(name)).collect();
        let spelled = labels.join(" requires ");
        crate::log::error!(
            "these applications require each other in a circle, so that none of them can ever start: {spelled}; \
             remove one of these requirements"
        );
        if self.stores.posts.root.post(RootEvent::RequirementCycle { names, labels }).is_err() {
            self.refuse("root", &"the node's root is too busy to hear of a cycle of requirements");
        }
    }

    /// The name, with that of its node where that is another one.
    fn with_node(&self, name: &str) -> String {
        let tid = self.core().called(name).first().copied();
        let Some(node) = tid.map(|tid| tid.node).filter(|node| *node != self.stores.node) else {
            return name.to_owned();
        };
        // NDL's lock and this core's are never held together.
        let members = stores::lock(&self.stores.ndl).members(Time::now());
        let called = members.into_iter().find(|member| member.node == node).map(|member| member.name);
        format!("{name} (node {})", called.unwrap_or_else(|| node.to_string()))
    }

    fn tid(&self) -> Tid {
        Tid::new(self.stores.node, AppAddress::SYNC)
    }

    fn stamp(&self, header: &mut Header) {
        header.sequence = self.core().next_sequence();
        header.sent = Time::now();
    }
}

/// So many events wait where another message is refused: whoever sends more than is read must not keep out what layers have to say, which is
/// told once.
const MESSAGES_MAX: usize = POST_CAPACITY / 2;

/// The same where a message says that a wait at a barrier is given up, which nobody says again: the barrier would open with whoever has gone.
const LEAVES_MAX: usize = POST_CAPACITY / 4 * 3;

/// Puts messages for the sync manager's TID into its post.
struct PostOutlet(Post<Event>);

impl Outlet for PostOutlet {
    fn submit(&self, message: Message) -> Result<(), Refused> {
        let is_leave = message.header.kind == LeaveBarrier::KIND;
        let most = if is_leave { LEAVES_MAX } else { MESSAGES_MAX };
        match self.0.post_below(most, Event::Message(message)) {
            Err(Event::Message(message)) => Err(Refused::new(message, Rejection::QueueFull)),
            // A full post hands back what it was given: a message.
            Ok(()) | Err(Event::App(_) | Event::Membership(_) | Event::Link(_) | Event::Monitors) => Ok(()),
        }
    }
}
