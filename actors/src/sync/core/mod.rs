//! The sync manager without clock and socket: facts in, orders out.
//!
//! After each [`Core::handle`] the shell takes [`Core::poll`] until nothing is left, and comes back with
//! [`Input::TimePassed`] at [`Core::next_wake`]. Outputs that were not taken stay here, so that an actor that fails
//! between two of them loses none.

mod answers;
mod apps;
mod barrier;
mod brief;
mod cycles;
mod directory;
mod meet;
mod peers;
mod reason;
mod rendezvous;
mod requirements;
#[cfg(test)]
mod simulation;
#[cfg(test)]
mod tests;

use std::{
    collections::{BTreeSet, VecDeque},
    time::Duration,
};

use bytes::Bytes;
use sinew_runtime::{
    app::{Requirement, RequirementEvent},
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::Kind,
};

pub(crate) use self::reason::Reason;
use self::{
    answers::Untaken,
    apps::{Apps, State, Wait},
    directory::Watchers,
    peers::{Accepted, Peers},
    rendezvous::Rendezvous,
};
use super::{
    facts::{DirectoryEntry, DirectoryEvent, OwnApp, Waiting},
    list::{ENTRIES_MAX, Ended, KINDS_MAX, List},
    words::{ArriveAtBarrier, BarrierAnswer},
};
use crate::{
    config::NodeConfig,
    gncl::LinkFact,
    lncl::AppFact,
    ndl::{LossReason, MembershipFact},
};

/// Names that two nodes have, of which it was said, at most; of more it is not said.
const SAME_NAMES_MAX: usize = 1_024;

/// What has happened.
#[derive(Debug)]
pub(crate) enum Input {
    /// An application of this node came, became ready, failed, went.
    AppChanged(AppFact),
    /// These groups have members on this node now.
    GroupsChanged(Vec<AppAddress>),
    /// A node is there, or not any more.
    MembershipChanged(MembershipFact),
    /// A node can be reached, or not any more.
    LinkChanged(LinkFact),
    /// The sync manager of `from` sent its list.
    ListReceived { from: NodeAddress, payload: Bytes },
    /// An application of this node has arrived at a barrier; the request has this correlation.
    Arrived { app: AppAddress, correlation: u64, asked: ArriveAtBarrier },
    /// It waits there no more; where a correlation is given, only the wait by the request that has it is over.
    Left { app: AppAddress, barrier: String, correlation: Option<u64> },
    /// It did not take this answer to its request.
    AnswerNotTaken { app: AppAddress, correlation: u64, answer: BarrierAnswer },
    /// The sync manager of `from` said who waits at barriers.
    ArrivalsReceived { from: NodeAddress, payload: Bytes },
    /// The queue to `to` did not take who waits at barriers.
    ArrivalsNotTaken { to: NodeAddress },
    /// This application, which is ready, wants to hear of the directory.
    DirectoryWanted { app: AppAddress },
    /// It did not take this event.
    DirectoryNotTaken { app: AppAddress, event: DirectoryEvent },
    /// The root did not take the release of this application.
    ReleaseNotTaken { app: AppAddress },
    /// This application did not take an event about the requirement `name`.
    EventNotTaken { app: AppAddress, name: String },
    /// The time of [`Core::next_wake`] has come.
    TimePassed,
}

/// What is to be done, or to be known.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum Output {
    /// All that this application requires is met: it may start. Once for each life of it.
    Release { app: AppAddress },
    /// Tell a running application that a requirement changed; of one that is lost, why.
    Tell { app: AppAddress, event: RequirementEvent, why: Option<Reason> },
    /// Tell an application that wants to hear of it what has changed in the directory.
    TellDirectory { app: AppAddress, event: DirectoryEvent },
    /// Send this list to the sync manager of `to`.
    Publish { to: NodeAddress, list: Bytes },
    /// Tell the sync manager of `to` who waits at barriers.
    PublishArrivals { to: NodeAddress, said: Bytes },
    /// Answer this request of an application that waited at a barrier.
    AnswerBarrier { app: AppAddress, correlation: u64, answer: BarrierAnswer },
    /// These groups have members on `node`.
    RouteGroups { node: NodeAddress, groups: Vec<AppAddress> },
    /// These names require each other in a circle, the first one again at the end: none of them is released.
    Cycle { names: Vec<String> },
    /// An application has waited for its deadline, once more.
    Overdue(Waiting),
    /// Several nodes have an application of this name; said once. Whoever asks for the name gets the first.
    SameName { name: String, tids: Vec<Tid> },
    /// Something was not used.
    Refused { cause: &'static str, detail: String },
}

/// Who is known on other nodes, and what waits for whom.
#[derive(Debug)]
pub(crate) struct Core {
    node: NodeAddress,
    incarnation: Incarnation,
    requirement_deadline: Duration,
    list_bytes_max: usize,
    apps: Apps,
    groups: Vec<AppAddress>,
    peers: Peers,
    rendezvous: Rendezvous,
    untaken: Untaken,
    watchers: Watchers,
    /// Of the names and patterns that are required here, those that somebody had at some time.
    seen: BTreeSet<String>,
    /// The cycles that stand, each without its closing name.
    cycles: BTreeSet<Vec<String>>,
    same_names: BTreeSet<String>,
    version: u64,
    /// The present list, once somebody needs it.
    encoded: Option<Bytes>,
    /// Outputs that were not taken: the release of an application, or its event about a name.
    not_taken: BTreeSet<(AppAddress, Option<String>)>,
    retry: Option<Time>,
    outputs: VecDeque<Output>,
    sequence: u64,
}

impl Core {
    /// Knows nobody yet. `config` is checked.
    #[must_use]
    pub(crate) fn new(config: &NodeConfig, node: NodeAddress, incarnation: Incarnation) -> Self {
        Self {
            node,
            incarnation,
            requirement_deadline: config.sync.requirement_deadline,
            list_bytes_max: config.payload_max,
            apps: Apps::default(),
            groups: Vec::new(),
            peers: Peers::new(config.ndl.nodes_max),
            rendezvous: Rendezvous::new(node, incarnation),
            untaken: Untaken::default(),
            watchers: Watchers::default(),
            seen: BTreeSet::new(),
            cycles: BTreeSet::new(),
            same_names: BTreeSet::new(),
            version: 1,
            encoded: None,
            not_taken: BTreeSet::new(),
            retry: None,
            outputs: VecDeque::new(),
            sequence: 0,
        }
    }

    /// Takes in what has happened.
    pub(crate) fn handle(&mut self, now: Time, input: Input) {
        if input.may_change_directory() {
            self.watchers.directory_changed();
        }
        match input {
            Input::AppChanged(fact) => self.app_changed(now, fact),
            Input::GroupsChanged(groups) => self.groups_changed(now, groups),
            Input::MembershipChanged(fact) => self.membership_changed(fact),
            Input::Arrived { app, correlation, asked } => self.arrived(now, app, correlation, asked),
            Input::Left { app, barrier, correlation } => {
                self.rendezvous.leave(now, app, &barrier, correlation)
            }
            Input::AnswerNotTaken { app, correlation, answer } => {
                return self.answer_not_taken(now, app, correlation, answer);
            }
            Input::ArrivalsReceived { from, payload } => self.arrivals_received(now, from, &payload),
            Input::ArrivalsNotTaken { to } => self.rendezvous.not_taken(now, to),
            Input::LinkChanged(fact) => self.link_changed(now, fact),
            Input::ListReceived { from, payload } => self.list_received(from, &payload),
            Input::DirectoryWanted { app } => self.watchers.add(app),
            Input::DirectoryNotTaken { app, event } => return self.directory_not_taken(now, app, event),
            Input::ReleaseNotTaken { app } => self.keep(now, app, None),
            Input::EventNotTaken { app, name } => self.keep(now, app, Some(name)),
            Input::TimePassed => {}
        }
        self.offer_again(now);
        self.answer_again(now);
        self.evaluate(now);
        self.report_overdue(now);
        self.publish(now);
        self.meet(now);
        self.tell_watchers(now);
    }

    /// The next thing to be done; take until there is none.
    pub(crate) fn poll(&mut self) -> Option<Output> {
        self.outputs.pop_front()
    }

    /// When to come back with [`Input::TimePassed`].
    pub(crate) fn next_wake(&self) -> Option<Time> {
        let overdue = self.apps.waiting().map(|(_, _, wait)| wait.overdue).min();
        let silent =
            self.apps.iter().flat_map(|(_, app)| app.silent.values().chain(&app.patience).copied()).min();
        [
            self.peers.next_due(),
            overdue,
            self.retry,
            silent,
            self.rendezvous.next_wake(),
            self.untaken.next_wake(),
            self.watchers.next_wake(),
        ]
        .into_iter()
        .flatten()
        .min()
    }

    /// The TIDs of the applications called `name`: of this node first, then of linked nodes, then of nodes whose link
    /// is down; of several nodes the one with the lowest address first. They need not be ready. spec: SYNC-6
    pub(crate) fn called(&self, name: &str) -> Vec<Tid> {
        let here = self.apps.called(name).map(|(app, _)| Tid::new(self.node, app));
        here.into_iter().chain(self.peers.resolve(name)).collect()
    }

    /// Every application that has a name, on this node and on all that are known and not lost, by name and address.
    pub(crate) fn directory(&self) -> Vec<DirectoryEntry> {
        let here = self.apps.iter().filter_map(|(address, app)| {
            let tid = Tid::new(self.node, address);
            Some((app.name.as_ref()?, tid, app.state == State::Ready, &app.kinds))
        });
        let mut entries: Vec<_> = here
            .chain(self.peers.directory())
            .map(|(name, tid, ready, kinds)| DirectoryEntry {
                name: name.to_string(),
                tid,
                ready,
                kinds: kinds.clone(),
            })
            .collect();
        entries.sort_by(|a, b| (&a.name, a.tid).cmp(&(&b.name, b.tid)));
        entries
    }

    /// Who waits at the barrier, for what, since when and why.
    pub(crate) fn waiting(&self, now: Time) -> Vec<Waiting> {
        self.apps.waiting().map(|(address, _, _)| address).filter_map(|app| self.wait_of(now, app)).collect()
    }

    /// The applications of this node, in the order of their addresses, at most `max`; and how many more there are.
    pub(crate) fn own_apps(&self, now: Time, max: usize) -> (Vec<OwnApp>, usize) {
        let view = |(address, app): (AppAddress, &apps::App)| OwnApp {
            app: address,
            name: app.name.as_ref().map(ToString::to_string),
            ready: app.state == State::Ready,
            missing: self.missing(now, address),
            waits: app.wait().map(|wait| now.since(wait.since)),
            ended: app.ended.map(|ended| Reason::from(ended).words()),
        };
        let apps: Vec<_> = self.apps.iter().take(max).map(view).collect();
        let more = self.apps.iter().count() - apps.len();
        (apps, more)
    }

    /// The number of the sync manager's next message. It counts on when the actor is restarted.
    pub(crate) const fn next_sequence(&mut self) -> u64 {
        self.sequence += 1;
        self.sequence
    }

    /// What this application lacks of what it requires, and why: what it waits for or, when it runs, what it was told is lost.
    pub(crate) fn missing(&self, now: Time, address: AppAddress) -> Vec<(String, &'static str)> {
        if let Some(waiting) = self.wait_of(now, address) {
            return waiting.missing;
        }
        let Some(app) = self.apps.get(address) else { return Vec::new() };
        let lost = app.requires.iter().filter(|requirement| app.lost.contains(requirement.as_str()));
        lost.flat_map(|requirement| self.missing_parts(address, requirement)).collect()
    }

    fn refuse(&mut self, cause: &'static str, detail: String) {
        self.outputs.push_back(Output::Refused { cause, detail });
    }
}

/// The applications of this node.
impl Core {
    fn app_changed(&mut self, now: Time, fact: AppFact) {
        match fact {
            // Told again, as after a restart of LNCL: nothing has changed.
            AppFact::Registered { app, name, requires }
                if self.apps.knows(app, name.as_deref(), &requires) => {}
            AppFact::Registered { app, name, requires } => {
                let wait = Wait::begun(now, self.requirement_deadline);
                let requires = self.read_requirements(app, requires);
                let refused = self.apps.register(app, name.clone(), requires, wait);
                if let Some(name) = refused {
                    self.refuse(
                        "name",
                        format!("{app} cannot be called {name:?}: not 1 to 63 bytes, or taken"),
                    );
                }
                self.forget_not_taken(app);
                self.life_ended(now, app);
                self.note_same_name(name.as_deref().unwrap_or_default());
                self.own_list_changed(now);
            }
            AppFact::Handles { app, kinds } => self.app_handles(now, app, kinds),
            AppFact::Ready { app } => self.app_ready(now, app),
            AppFact::Down { app } => self.app_ended(now, app, Ended::Failed),
            AppFact::Stopped { app } => self.app_ended(now, app, Ended::Stopped),
            AppFact::Unregistered { app } => {
                self.apps.remove(app);
                self.forget_not_taken(app);
                self.life_ended(now, app);
                self.own_list_changed(now);
            }
            // The shell looks up which they are and says so by `Input::GroupsChanged`.
            AppFact::GroupsChanged => {}
        }
    }

    /// What its door has checked. A text that is none all the same is a name that nobody has: who asks for it does not start.
    fn read_requirements(&mut self, app: AppAddress, texts: Vec<String>) -> Vec<Requirement> {
        let read = |text: String| {
            text.parse().unwrap_or_else(|fault| {
                self.refuse("requirement", format!("of {app}: {fault}"));
                Requirement::name(text)
            })
        };
        texts.into_iter().map(read).collect()
    }

    fn app_handles(&mut self, now: Time, address: AppAddress, mut kinds: Vec<Kind>) {
        kinds.truncate(KINDS_MAX);
        if let Some(app) = self.apps.get_mut(address)
            && app.kinds != kinds
        {
            app.kinds = kinds;
            self.own_list_changed(now);
        }
    }

    fn app_ready(&mut self, now: Time, address: AppAddress) {
        if let Some(app) = self.apps.get_mut(address)
            && app.state != State::Ready
        {
            (app.state, app.ended) = (State::Ready, None);
            self.own_list_changed(now);
        }
    }

    /// It waits again for all that it requires; one that waits already was not started yet and goes on waiting.
    fn app_ended(&mut self, now: Time, address: AppAddress, how: Ended) {
        self.life_ended(now, address);
        let wait = Wait::begun(now, self.requirement_deadline);
        if let Some(app) = self.apps.get_mut(address)
            && app.wait().is_none()
        {
            // What it was told is lost stays so: an event may still be on its way, and its next life has to hear the end of it.
            (app.state, app.ended) = (State::Waiting(wait), Some(how));
            app.silent.clear();
            self.forget_not_taken(address);
            self.own_list_changed(now);
        }
    }

    /// What it waited for and wanted to hear it does not any more.
    fn life_ended(&mut self, now: Time, app: AppAddress) {
        self.rendezvous.ended(now, app);
        self.untaken.forget(app);
        self.watchers.remove(app);
    }

    fn groups_changed(&mut self, now: Time, mut groups: Vec<AppAddress>) {
        groups.retain(|group| group.is_group());
        if self.groups != groups {
            self.groups = groups;
            self.own_list_changed(now);
        }
    }
}

/// The other nodes.
impl Core {
    fn membership_changed(&mut self, fact: MembershipFact) {
        match fact {
            MembershipFact::NodeFound { node, incarnation, .. } => {
                self.peers.found(node, incarnation);
                self.route_groups(node);
            }
            MembershipFact::NodeLost { node, incarnation, why } => {
                let reason = match why {
                    LossReason::Left => Reason::NodeLeft,
                    LossReason::Crashed
                    | LossReason::Hung
                    | LossReason::LinkDown
                    | LossReason::Restarted
                    | LossReason::Duplicate => Reason::NodeLost,
                };
                self.peers.lost(node, incarnation, reason);
                self.hear_no_more(node);
                self.route_groups(node);
            }
        }
    }

    fn link_changed(&mut self, now: Time, fact: LinkFact) {
        match fact {
            LinkFact::LinkUp { node, incarnation } => {
                if !self.peers.link_up(now, node, incarnation) {
                    self.refuse(
                        "nodes",
                        format!("{node} is linked, but `ndl.nodes_max` nodes are known already"),
                    );
                }
                self.rendezvous.link_up(now, node);
                self.route_groups(node);
            }
            LinkFact::LinkBroken { node, incarnation } => {
                self.peers.link_broken(node, incarnation);
                self.hear_no_more(node);
            }
            // A link that was refused was down before. Whether its node is lost, NDL says.
            LinkFact::DialRefused { .. } => {}
            LinkFact::PeerLeft { node, incarnation } => {
                self.peers.lost(node, incarnation, Reason::NodeLeft);
                self.peers.link_broken(node, incarnation);
                self.hear_no_more(node);
                self.route_groups(node);
            }
        }
    }

    fn list_received(&mut self, from: NodeAddress, payload: &[u8]) {
        if from == self.node || !from.is_single() {
            return self.refuse("directory", format!("{from} is not another node"));
        }
        // A list that is longer than ours may be is not even looked at.
        if payload.len() > self.list_bytes_max {
            return self.refuse("directory", format!("{from} sent {} bytes", payload.len()));
        }
        match List::parse(payload) {
            Err(fault) => self.refuse("directory", format!("from {from}: {fault}")),
            Ok(list) => match self.peers.accept(from, list) {
                Err(why) => self.refuse("directory", format!("from {from}: {why}")),
                Ok(Accepted::New) => {
                    self.route_groups(from);
                    for name in self.peers.names_of(from) {
                        self.note_same_name(&name);
                    }
                }
                Ok(Accepted::Same | Accepted::Old) => {}
            },
        }
    }

    /// What `node` said of barriers does not count any more, unless news of a former life changed nothing.
    fn hear_no_more(&mut self, node: NodeAddress) {
        if self.peers.current(node).is_none() {
            self.rendezvous.silent(node);
        }
    }

    fn route_groups(&mut self, node: NodeAddress) {
        if let Some(groups) = self.peers.changed_groups(node) {
            self.outputs.push_back(Output::RouteGroups { node, groups });
        }
    }

    fn note_same_name(&mut self, name: &str) {
        let tids = self.called(name);
        if tids.len() > 1 && self.same_names.len() < SAME_NAMES_MAX && self.same_names.insert(name.to_owned())
        {
            self.outputs.push_back(Output::SameName { name: name.to_owned(), tids });
        }
    }

    fn own_list_changed(&mut self, now: Time) {
        self.version += 1;
        self.encoded = None;
        self.peers.make_due(now);
    }

    /// Sends the list to whom it is due. spec: SYNC-2
    fn publish(&mut self, now: Time) {
        for to in self.peers.take_due(now) {
            let list = self.encoded();
            self.outputs.push_back(Output::Publish { to, list });
        }
    }

    fn encoded(&mut self) -> Bytes {
        if let Some(bytes) = &self.encoded {
            return bytes.clone();
        }
        let list = List {
            incarnation: self.incarnation,
            version: self.version,
            entries: self.apps.entries(),
            groups: self.groups.clone(),
        };
        let (bytes, left_out) = list.encode(self.list_bytes_max);
        if left_out > 0 {
            let limit = self.list_bytes_max;
            let detail = format!(
                "{left_out} applications are not in this node's directory, which has at most {ENTRIES_MAX} entries \
                 and {limit} bytes: other nodes cannot find them by name; raise `node.payload_max` or use more nodes"
            );
            self.refuse("directory full", detail);
        }
        self.encoded = Some(bytes.clone());
        bytes
    }
}
