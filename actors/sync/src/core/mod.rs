//! The core of the sync manager. It has no clock and no socket; it takes inputs and returns outputs.
//!
//! After each [`Core::handle`] the shell calls [`Core::poll`] until it returns `None`. At [`Core::next_wake`]
//! it passes [`Input::TimePassed`]. Rejected outputs stay in the core, so that an actor that fails between
//! two of them loses none.

mod apps;
mod barriers;
mod directory;
mod grace_period;
mod outputs;
mod own_list;
mod peers;
mod queries;
mod readiness;
mod reason;
mod retry;
mod start_barrier;
mod subscribers;
#[cfg(test)]
mod tests;

use bytes::Bytes;
use sinew_model::{
    barrier::{ArriveAtBarrier, BarrierAnswer},
    config::NodeConfig,
    directory::{DirectoryEvent, Waiting},
    facts::{AppFact, LinkFact, MembershipFact},
};
use sinew_runtime::{
    app::RequirementEvent,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
};

pub(crate) use self::directory::NamesChanged;
use self::{
    apps::{AppChange, Apps},
    barriers::{Barriers, Request},
    directory::{Directory, DuplicateNames},
    grace_period::GracePeriod,
    outputs::Outputs,
    own_list::OwnList,
    peers::{Accepted, Peers},
    readiness::Readiness,
    start_barrier::StartBarrier,
    subscribers::Subscribers,
};
#[doc(hidden)]
pub use self::{
    barriers::rendezvous::{BarrierKey, BarrierState, Rendezvous},
    own_list::REPEAT,
    retry::RETRY,
    start_barrier::UNREACHABLE_MAX,
};
pub use self::{reason::Reason, start_barrier::cycle_of};
use super::list::Published;

/// An event that the core handles.
#[derive(Clone, Debug)]
pub enum Input {
    /// An application of this node registered, became ready, failed, or unregistered.
    AppChanged(AppFact),
    /// The groups that have members on this node changed.
    GroupsChanged(Published),
    /// A node was found, or lost.
    MembershipChanged(MembershipFact),
    /// A node became reachable, or unreachable.
    LinkChanged(LinkFact),
    /// The sync manager of `from` sent its list.
    ListReceived { from: NodeAddress, payload: Bytes },
    /// An application of this node has arrived at a barrier; the request has this correlation.
    Arrived { app: AppAddress, correlation: u64, asked: ArriveAtBarrier },
    /// An application has left a barrier. With a correlation, only the wait by that request is over.
    Left { app: AppAddress, barrier: String, correlation: Option<u64> },
    /// The application's mailbox rejected this answer to its request.
    AnswerRejected { app: AppAddress, correlation: u64, answer: BarrierAnswer },
    /// The queue to `to` rejected this node's list.
    ListRejected { to: NodeAddress },
    /// The sync manager of `from` sent its barrier state.
    ArrivalsReceived { from: NodeAddress, payload: Bytes },
    /// The queue to `to` rejected this node's barrier state.
    ArrivalsRejected { to: NodeAddress },
    /// This application is ready and has subscribed to the directory.
    DirectoryWanted { app: AppAddress },
    /// The application's mailbox rejected this directory event.
    DirectoryRejected { app: AppAddress, event: DirectoryEvent },
    /// The root rejected the release of this application.
    ReleaseRejected { app: AppAddress },
    /// The application's mailbox rejected an event about the requirement `name`.
    EventRejected { app: AppAddress, name: String },
    /// An application with a full mailbox has room again, or may have: a new shell begins with this.
    RoomMade,
    /// The time of [`Core::next_wake`] has been reached.
    TimePassed,
}

/// An action or a report for the shell.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Output {
    /// Release the application: all its requirements are met. This output occurs once for each of its lives.
    Release { app: AppAddress },
    /// Notify a running application of a changed requirement, with the reason if it is lost.
    Notify { app: AppAddress, event: RequirementEvent, why: Option<Reason> },
    /// Send a change of the directory to a subscribed application.
    NotifyDirectory { app: AppAddress, event: DirectoryEvent },
    /// Send this list to the sync manager of `to`.
    Publish { to: NodeAddress, list: Bytes },
    /// Send this barrier state to the sync manager of `to`.
    PublishArrivals { to: NodeAddress, frame: Bytes },
    /// Answer this request of an application that waited at a barrier.
    AnswerBarrier { app: AppAddress, correlation: u64, answer: BarrierAnswer },
    /// Route these groups to `node`, which has members of them.
    RouteGroups { node: NodeAddress, groups: Vec<AppAddress> },
    /// Report a cycle of requirements, closed with its first name. None of these applications is released.
    Cycle { names: Vec<String> },
    /// Report an application again that has waited beyond its deadline.
    Overdue(Waiting),
    /// Report a wait for a name that no application has, with up to three similar names and their states.
    Misspelt { application: String, name: String, nearest: Vec<String> },
    /// Report, once, that several nodes have an application of this name. The name resolves to the first.
    SameName { name: String, tids: Vec<Tid> },
    /// Report input that was rejected.
    Refused { cause: &'static str, detail: String },
}

/// The known applications of all nodes, and the waits of the local ones.
///
/// Each part has its own state. The core passes the inputs to the parts, and lets them add their outputs to
/// one queue.
#[derive(Debug)]
pub struct Core {
    apps: Apps,
    peers: Peers,
    own_list: OwnList,
    start_barrier: StartBarrier,
    barriers: Barriers,
    subscribers: Subscribers,
    duplicate_names: DuplicateNames,
    grace_period: GracePeriod,
    outputs: Outputs,
    /// The event and the input that were handled last.
    handled: InputPosition,
    sequence: u64,
}

/// The number of an event in the event queue, from 1, and the number of an input of that event.
pub type InputPosition = (u64, u32);

impl Core {
    /// Returns a core without other nodes and applications. `config` is already validated.
    #[must_use]
    pub fn new(config: &NodeConfig, node: NodeAddress, incarnation: Incarnation) -> Self {
        let bytes_max = config.payload_max;
        Self {
            apps: Apps::new(config.sync.requirement_deadline),
            peers: Peers::new(node, config.ndl.nodes_max, bytes_max),
            own_list: OwnList::new(incarnation, bytes_max),
            start_barrier: StartBarrier::default(),
            barriers: Barriers::new(node, incarnation, bytes_max),
            subscribers: Subscribers::default(),
            duplicate_names: DuplicateNames::default(),
            grace_period: GracePeriod::default(),
            outputs: Outputs::default(),
            handled: (0, 0),
            sequence: 0,
        }
    }

    /// Reports that the shell runs, with `unread` queued events behind the current one. The shell calls this
    /// before each input, so that the core measures the delay of its deadlines.
    pub fn woken(&mut self, now: Time, unread: usize) {
        if let Some(due) = self.next_wake() {
            self.grace_period.woken(now, due, unread);
        }
    }

    /// Handles an input, unless it was handled before. The event in progress of a failed actor is delivered
    /// to its successor too, and both use this core. An arrival that is counted twice would open the next
    /// round in its application's absence.
    pub fn handle_once(&mut self, now: Time, position: InputPosition, input: Input) {
        if position > self.handled {
            self.handle(now, input);
            self.handled = position;
        }
    }

    /// Handles an input.
    pub fn handle(&mut self, now: Time, input: Input) {
        let outputs = &mut self.outputs;
        match input {
            Input::AppChanged(fact) => self.app_changed(now, fact),
            Input::GroupsChanged(published) => {
                if self.own_list.set_groups(published) {
                    self.own_list_changed(now);
                }
            }
            Input::MembershipChanged(fact) => self.membership_changed(fact),
            Input::LinkChanged(fact) => self.link_changed(now, fact),
            Input::ListReceived { from, payload } => self.list_received(from, &payload),
            Input::Arrived { app, correlation, asked } => {
                let request = Request { app, correlation, asked };
                if self.barriers.arrived(now, request, &mut self.apps, outputs) {
                    self.own_list_changed(now);
                }
            }
            Input::Left { app, barrier, correlation } => self.barriers.left(now, app, &barrier, correlation),
            Input::ArrivalsReceived { from, payload } => {
                self.barriers.frame_received(now, (from, &payload), &mut self.peers, outputs);
            }
            Input::ArrivalsRejected { to } => self.barriers.frame_rejected(now, to),
            Input::DirectoryWanted { app } => self.subscribers.add(app),
            Input::ReleaseRejected { app } => self.start_barrier.release_rejected(now, app, outputs),
            Input::EventRejected { app, name } => self.start_barrier.event_rejected(app, name),
            // These are only sent again: nothing else depends on them.
            Input::AnswerRejected { app, correlation, answer } => {
                return self.barriers.answer_rejected(now, (app, correlation, answer), outputs);
            }
            Input::ListRejected { to } => return self.own_list.rejected(now, to),
            Input::DirectoryRejected { app, event } => {
                return self.subscribers.rejected(app, event, outputs);
            }
            Input::RoomMade => {
                self.start_barrier.room_made(now, &mut self.apps, &self.peers, outputs);
                self.subscribers.room_made();
            }
            Input::TimePassed => {}
        }
        self.evaluate(now);
    }

    /// Lets each part act on the changed state of the others.
    fn evaluate(&mut self, now: Time) {
        let Self { apps, peers, own_list, start_barrier, barriers, subscribers, outputs, .. } = self;
        start_barrier.offer_again(now, apps, peers, outputs);
        barriers.offer_again(now, outputs);
        // The list is published first, because other nodes are farther away. Released local applications
        // would take the processor that sends it.
        own_list.publish(now, apps, peers, outputs);
        let moment = self.grace_period.moment(now);
        start_barrier.evaluate(moment, (apps, peers), barriers.awaited(), outputs);
        let directory = Directory { apps, peers };
        barriers.evaluate(moment, Readiness { directory, findings: start_barrier.findings() }, outputs);
        subscribers.notify(directory, outputs);
    }

    fn app_changed(&mut self, now: Time, fact: AppFact) {
        match self.apps.handle(now, fact, &mut self.outputs) {
            AppChange::Nothing => return,
            AppChange::EndedWaiting(app) => return self.life_ended(now, app),
            AppChange::Entry => {}
            AppChange::Ended(app) => {
                self.life_ended(now, app);
                self.start_barrier.ended(app, &mut self.apps);
            }
            AppChange::Registered(app, name) => {
                self.start_barrier.forget(app);
                self.life_ended(now, app);
                self.check_duplicates(name.as_deref().unwrap_or_default());
            }
            AppChange::Unregistered(app) => {
                self.start_barrier.forget(app);
                self.life_ended(now, app);
            }
        }
        self.own_list_changed(now);
    }

    /// Removes the waits and subscriptions of an ended life.
    fn life_ended(&mut self, now: Time, app: AppAddress) {
        self.barriers.ended(now, app);
        self.subscribers.remove(app);
    }

    fn own_list_changed(&mut self, now: Time) {
        self.own_list.changed(now);
        // Changes of groups and phases count, too, although the directory does not contain them. They are
        // rare.
        self.subscribers.directory_changed();
    }

    fn membership_changed(&mut self, fact: MembershipFact) {
        self.subscribers.directory_changed();
        let absent = self.peers.membership_changed(fact, &mut self.outputs);
        self.invalidate(absent);
    }

    fn link_changed(&mut self, now: Time, fact: LinkFact) {
        self.subscribers.directory_changed();
        let up = if let LinkFact::LinkUp { node, .. } = fact { Some(node) } else { None };
        let absent = self.peers.link_changed(fact, &mut self.outputs);
        self.invalidate(absent);
        if let Some(node) = up {
            self.own_list.link_up(now, node);
            self.barriers.link_up(now, node);
        }
    }

    /// Invalidates the barrier state of a node, unless the event was about an earlier incarnation and changed
    /// nothing.
    fn invalidate(&mut self, absent: Option<NodeAddress>) {
        if let Some(node) = absent.filter(|node| self.peers.current(*node).is_none()) {
            self.barriers.invalidate(node);
        }
    }

    fn list_received(&mut self, from: NodeAddress, payload: &[u8]) {
        let accepted = self.peers.list_received(from, payload, &mut self.outputs);
        if matches!(accepted, Some(Accepted::New | Accepted::Again)) {
            self.subscribers.directory_changed();
        }
        if accepted == Some(Accepted::New) {
            for name in self.peers.names_of(from) {
                self.check_duplicates(&name);
            }
        }
    }

    fn check_duplicates(&mut self, name: &str) {
        let directory = Directory { apps: &self.apps, peers: &self.peers };
        self.duplicate_names.check(name, directory, &mut self.outputs);
    }

    /// Returns whether an entry of the directory was added, removed or changed since the last call. The
    /// caller then copies the directory again, so a repetition of known state must not set the flag.
    pub const fn take_directory_changed(&mut self) -> bool {
        self.subscribers.take_changed()
    }

    /// Returns the next output. The caller repeats this until it returns `None`.
    pub fn poll(&mut self) -> Option<Output> {
        self.outputs.poll()
    }

    /// Handles the replacement of the actor that took the last output. The actor may or may not have executed
    /// it, and nothing requests it again. An answer about a barrier is therefore sent again; its receiver
    /// counts a second one as a late reply. Any other output of this kind counts as rejected.
    pub fn replaced(&mut self, now: Time) {
        let outputs = &mut self.outputs;
        match outputs.take_in_progress() {
            Some(answer @ Output::AnswerBarrier { .. }) => outputs.put_back(answer),
            Some(Output::Release { app }) => self.start_barrier.release_rejected(now, app, outputs),
            Some(Output::Notify { app, event, .. }) => {
                self.start_barrier.event_rejected(app, event.name().to_owned());
            }
            Some(Output::NotifyDirectory { app, event }) => self.subscribers.rejected(app, event, outputs),
            Some(_) | None => {}
        }
    }

    /// Returns the time at which the shell must pass [`Input::TimePassed`].
    pub fn next_wake(&self) -> Option<Time> {
        let deadlines = [self.start_barrier.next_deadline(&self.apps), self.barriers.next_deadline()];
        let deadline = deadlines.into_iter().flatten().min().map(|at| self.grace_period.postponed(at));
        let publications = [self.own_list.next_wake(&self.peers), self.barriers.next_due()];
        let retry = self.start_barrier.next_retry();
        publications.into_iter().chain([retry, deadline]).flatten().min()
    }

    /// Returns the run-time barriers, for simulations.
    #[doc(hidden)]
    pub const fn rendezvous(&self) -> &Rendezvous {
        self.barriers.rendezvous()
    }

    /// Returns the run-time barriers, for simulations that change them.
    #[doc(hidden)]
    pub const fn rendezvous_mut(&mut self) -> &mut Rendezvous {
        self.barriers.rendezvous_mut()
    }

    /// Returns the number of the sync manager's next message. The counter continues after a restart of the
    /// actor.
    pub const fn next_sequence(&mut self) -> u64 {
        self.sequence += 1;
        self.sequence
    }
}
