//! The sync manager's shell: passes inputs to its core and executes the outputs.

mod outputs;

use std::sync::{Arc, MutexGuard, PoisonError};

use actix::{Actor, ActorContext, ActorFutureExt, AsyncContext, Context, SpawnHandle, StreamHandler, fut};
use sinew_model::{
    barrier::{ArriveAtBarrier, LeaveBarrier},
    directory::DirectoryEvent,
    facts::{AppFact, LinkFact, MembershipFact},
    limits::EVENT_QUEUE_CAPACITY,
    notifications::claim_notifications,
    refusals::Refusals,
};
use sinew_runtime::{
    event_queue::EventQueue,
    outcome::{Outcome, Rejection},
    router::{LocalRoute, MessageSink, SubmitError},
    supervision::ReadyGate,
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Flags, Kind, Message, Payload},
};

use super::{
    Event,
    core::{Core, Input, InputPosition, NamesChanged},
    list::Published,
};
use crate::{State, monitors, wills};

/// The sync manager of a node. After each fault a new one is created on the same core.
pub struct SyncManager {
    state: Arc<State>,
    ready: Option<ReadyGate>,
    refusals: Arc<Refusals>,
    /// The current event and the number of inputs that it has caused. `None` while the timer's input is
    /// handled.
    in_progress: Option<InputPosition>,
    /// The pending timer and its time.
    timer: Option<(Time, SpawnHandle)>,
}

impl SyncManager {
    /// Returns a sync manager on the core in `state`. It opens `ready` when messages reach it.
    pub fn new(state: Arc<State>, ready: ReadyGate) -> Self {
        let refusals = state.ctx.refusals.clone();
        Self { state, ready: Some(ready), refusals, in_progress: None, timer: None }
    }
}

impl Actor for SyncManager {
    type Context = Context<Self>;

    fn started(&mut self, ctx: &mut Self::Context) {
        ctx.add_stream(self.state.ctx.event_queues.sync.attach_keeping(Event::copy).numbered());
        let sink = Arc::new(QueueSink(self.state.ctx.event_queues.sync.clone()));
        self.state.ctx.router.set_local(AppAddress::SYNC, LocalRoute { sink, events: Arc::new([]) });
        // A predecessor may have failed between two outputs of the core, or before it processed the groups.
        self.core().replaced(Time::now());
        self.state.ctx.mark_groups_read();
        self.read_groups();
        claim_notifications(&self.state.ctx.room_notifier.sync_events);
        self.offer_again(ctx);
        wills::feed(&self.state, wills::Input::TimePassed);
        self.offer_backlog();
        if let Some(ready) = self.ready.take() {
            ready.reached();
        }
    }
}

impl StreamHandler<(u64, Event)> for SyncManager {
    fn handle(&mut self, (number, event): (u64, Event), ctx: &mut Self::Context) {
        self.in_progress = Some((number, 0));
        self.handle_event(event, ctx);
        self.in_progress = None;
    }

    /// Stops this actor: the event queue has another reader, because the actor was replaced.
    fn finished(&mut self, ctx: &mut Self::Context) {
        ctx.stop();
    }
}

impl SyncManager {
    fn handle_event(&mut self, event: Event, ctx: &mut Context<Self>) {
        match event {
            Event::App(fact) => {
                if matches!(fact, AppFact::GroupsChanged) {
                    self.state.ctx.mark_groups_read();
                }
                // An application that unregisters also leaves its groups.
                let groups_may_differ = matches!(fact, AppFact::GroupsChanged | AppFact::Unregistered { .. });
                if groups_may_differ {
                    self.read_groups();
                }
                let ready = if let AppFact::Ready { app } = fact { Some(app) } else { None };
                self.handle(Input::AppChanged(fact), ctx);
                if let Some(app) =
                    ready.filter(|app| self.state.ctx.router.subscribes(*app, DirectoryEvent::KIND))
                {
                    self.handle(Input::DirectoryWanted { app }, ctx);
                }
            }
            Event::Membership(fact) => {
                monitors::feed(&self.state, (&fact).into());
                if let MembershipFact::NodeLost { node, incarnation, .. } = fact
                    && wills::is_revoked(&self.state, (node, incarnation))
                {
                    // GNCL may not have read the current revocation list yet.
                    wills::revoke(&self.state, node, incarnation);
                }
                if let Some(input) = wills::Input::of_membership(&fact) {
                    wills::feed(&self.state, input);
                }
                self.handle(Input::MembershipChanged(fact), ctx);
            }
            Event::Link(fact) => {
                if let Some(input) = monitors::Input::of_link(&fact) {
                    monitors::feed(&self.state, input);
                }
                if let Some(input) = wills::Input::of_link(&fact) {
                    wills::feed(&self.state, input);
                }
                if let LinkFact::LinkUp { node, .. } = fact {
                    // Before its groups are routed, which hands over the values of groups that are new.
                    self.state.ctx.router.linked_again(node);
                }
                self.handle(Input::LinkChanged(fact), ctx);
            }
            Event::Monitors => {
                monitors::drain(&self.state);
                self.set_timer(ctx);
            }
            Event::Message(message) => self.receive(message, ctx),
        }
        self.offer_backlog();
    }

    /// Sends the events that full applications rejected, now and whenever one of them has room again.
    fn offer_again(&mut self, ctx: &mut Context<Self>) {
        monitors::feed(&self.state, monitors::Input::RoomMade);
        self.handle(Input::RoomMade, ctx);
        let context = self.state.ctx.clone();
        let has_room = fut::wrap_future(async move { context.room_notifier.sync_events.notified().await });
        ctx.spawn(has_room.map(|(), manager: &mut Self, ctx| manager.offer_again(ctx)));
    }

    /// Sends the events that were rejected by a full event queue, as far as there is room now.
    fn offer_backlog(&self) {
        self.state.ctx.app_backlogs.offer_to_sync(&self.state.ctx.event_queues);
        if monitors::has_outputs(&self.state) {
            monitors::drain(&self.state);
        }
    }

    fn core(&self) -> MutexGuard<'_, Core> {
        self.state.core.lock().unwrap_or_else(PoisonError::into_inner)
    }

    fn read_groups(&self) {
        // The guests are read first. A guest that registers and joins a group in between causes another
        // event.
        let guests = self.state.security.access.get().map(|access| access.guests()).unwrap_or_default();
        let published = Published::of(self.state.ctx.router.groups_with_members(), &guests);
        if let Some(left_out) = published.left_out() {
            self.refuse("directory full", &left_out);
        }
        let (mut core, now) = (self.core(), Time::now());
        core.woken(now, self.state.ctx.event_queues.sync.len());
        core.handle(now, Input::GroupsChanged(published));
    }

    fn handle(&mut self, input: Input, ctx: &mut Context<Self>) {
        self.in_progress = self.in_progress.map(|(event, inputs)| (event, inputs + 1));
        let position = self.in_progress;
        {
            let mut core = self.core();
            let (changed, now) = (input.names_changed(), Time::now());
            core.woken(now, self.state.ctx.event_queues.sync.len());
            match position {
                Some(position) => core.handle_once(now, position, input),
                None => core.handle(now, input),
            }
            self.update_access(&core, changed);
            // The change is counted before it is visible. Otherwise an application that learns a name from
            // another one could find an unchanged directory.
            if core.take_directory_changed() {
                self.state.ctx.directory_has_changed();
            }
        }
        // The outputs are executed one at a time and without the lock: an output may cause a query of the
        // directory.
        loop {
            let Some(output) = self.core().poll() else { break };
            self.execute(output);
        }
        self.set_timer(ctx);
    }

    /// Passes the names of other nodes to the access list, before any application learns them. The access
    /// list judges messages by these names.
    fn update_access(&self, core: &Core, changed: NamesChanged) {
        let Some(access) = self.state.security.access.get() else { return };
        match changed {
            NamesChanged::None => {}
            NamesChanged::Of(node) => access.set_remote_names(Some(node), core.names_elsewhere(Some(node))),
            NamesChanged::All => access.set_remote_names(None, core.names_elsewhere(None)),
        }
    }

    /// Handles a frame from the sync manager of a peer. Rejects any other message.
    fn receive(&mut self, mut message: Message, ctx: &mut Context<Self>) {
        let Tid { node, app } = message.header.source;
        if matches!(message.header.kind, ArriveAtBarrier::KIND | LeaveBarrier::KIND) {
            return self.receive_request(message, ctx);
        }
        let is_monitor_or_will =
            matches!(message.header.kind, Kind::SYNC_WATCH | Kind::SYNC_LIVES | Kind::SYNC_WILLS);
        let handler = match message.header.kind {
            Kind::SYNC_AUDIT_ASK | Kind::SYNC_AUDIT => Some(("audit", &self.state.audits)),
            Kind::SYNC_FREEZE => Some(("trigger", &self.state.triggers)),
            Kind::SYNC_SCHEMA_ASK | Kind::SYNC_SCHEMA | Kind::SYNC_MISMATCH => {
                Some(("types", &self.state.types))
            }
            _ => None,
        };
        if !matches!(message.header.kind, Kind::SYNC_DIRECTORY | Kind::SYNC_ARRIVALS)
            && !is_monitor_or_will
            && handler.is_none()
        {
            let kind = message.header.kind;
            self.refuse(
                "kind",
                &format_args!("{node}/{app} sent kind {kind}, which a sync manager does not accept"),
            );
            message.reject(Rejection::UnknownKind);
        } else if app != AppAddress::SYNC || node == self.state.ctx.node {
            self.refuse("source", &format_args!("{node}/{app} is not the sync manager of another node"));
            message.reject(Rejection::ForgedSource);
        } else if let Some((cause, handler)) = handler {
            let received = handler.get().map_or(Ok(()), |handler| handler.receive(node, &message));
            if let Err(fault) = received {
                self.refuse(cause, &fault);
            }
            message.settle(Outcome::Delivered);
        } else if is_monitor_or_will {
            let received = if message.header.kind == Kind::SYNC_WILLS {
                wills::receive(&self.state, node, &message)
            } else {
                monitors::receive(&self.state, node, &message)
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

    /// Handles a barrier request from an application of this node. spec: SYNC-10
    fn receive_request(&mut self, mut message: Message, ctx: &mut Context<Self>) {
        let Tid { node, app } = message.header.source;
        let is_arrival = message.header.kind == ArriveAtBarrier::KIND;
        if node != self.state.ctx.node {
            self.refuse("barrier", &format_args!("{node}/{app} must send barrier requests to its own node"));
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

    fn set_timer(&mut self, ctx: &mut Context<Self>) {
        let monitors = monitors::next_wake(&self.state);
        let wills = wills::next_wake(&self.state);
        let wake = [self.core().next_wake(), monitors, wills].into_iter().flatten().min();
        if self.timer.as_ref().map(|(at, _)| *at) == wake {
            return;
        }
        if let Some((_, former)) = self.timer.take() {
            ctx.cancel_future(former);
        }
        self.timer = wake.map(|at| {
            let timer = ctx.run_later(at.since(Time::now()), |manager, ctx| {
                manager.timer = None;
                monitors::feed(&manager.state, monitors::Input::TimePassed);
                wills::feed(&manager.state, wills::Input::TimePassed);
                manager.handle(Input::TimePassed, ctx);
            });
            (at, timer)
        });
    }
}

/// Maximum number of queued events with which a message is accepted. Senders must not displace the events of
/// the layers, which are posted once.
const MESSAGES_MAX: usize = EVENT_QUEUE_CAPACITY / 2;

/// The same limit for a message that ends a wait at a barrier. The message is never repeated: without it the
/// barrier would open with an application that has left.
const LEAVES_MAX: usize = EVENT_QUEUE_CAPACITY / 4 * 3;

/// Puts messages for the sync manager's TID into its event queue.
struct QueueSink(EventQueue<Event>);

impl MessageSink for QueueSink {
    fn submit(&self, message: Message) -> Result<(), SubmitError> {
        let is_leave = message.header.kind == LeaveBarrier::KIND;
        let most = if is_leave { LEAVES_MAX } else { MESSAGES_MAX };
        match self.0.post_below(most, Event::Message(message)) {
            Err(Event::Message(message)) => Err(SubmitError::new(message, Rejection::QueueFull)),
            // A full event queue returns the rejected event, which is a message.
            Ok(()) | Err(Event::App(_) | Event::Membership(_) | Event::Link(_) | Event::Monitors) => Ok(()),
        }
    }
}
