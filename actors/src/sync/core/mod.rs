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
mod lives;
mod meet;
mod misspelt;
mod nodes;
mod peers;
mod phases;
mod publish;
mod reason;
mod rendezvous;
mod requirements;
mod respite;
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
    app::RequirementEvent,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
};

pub(in crate::sync) use self::directory::Named;
use self::{
    answers::Undelivered,
    apps::{Apps, State},
    directory::Watchers,
    peers::Peers,
    phases::Phases,
    rendezvous::Rendezvous,
    respite::Respite,
};
pub(crate) use self::{cycles::circle_of, reason::Reason};
use super::{
    facts::{Absence, DirectoryEntry, DirectoryEvent, OwnApp, Waiting},
    list::Published,
    words::{ArriveAtBarrier, BarrierAnswer},
};
use crate::{config::NodeConfig, gncl::LinkFact, lncl::AppFact, ndl::MembershipFact};

/// What has happened.
#[derive(Clone, Debug)]
pub(crate) enum Input {
    /// An application of this node came, became ready, failed, went.
    AppChanged(AppFact),
    /// These groups have members on this node now.
    GroupsChanged(Published),
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
    /// The queue to `to` did not take this node's list.
    ListNotTaken { to: NodeAddress },
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
    /// An application waits for a name that nobody has; up to three similar names, with their states.
    Misspelt { application: String, name: String, nearest: Vec<String> },
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
    /// How many of these, the first ones, have a member among the robot's own.
    own_groups: usize,
    peers: Peers,
    rendezvous: Rendezvous,
    phases: Phases,
    undelivered: Undelivered,
    watchers: Watchers,
    /// Of the names and patterns that are required here, those that somebody had at some time.
    seen: BTreeSet<String>,
    /// The cycles that stand, each without its closing name.
    cycles: BTreeSet<Vec<String>>,
    same_names: BTreeSet<String>,
    /// Whether the directory may have changed since somebody asked that.
    has_changed: bool,
    version: u64,
    /// The present list, once somebody needs it.
    encoded: Option<Bytes>,
    /// Least time from the last one that somebody needed to the next one.
    spacing: Duration,
    /// Outputs that were not taken: the release of an application, or its event about a name.
    not_taken: BTreeSet<(AppAddress, Option<String>)>,
    retry: Option<Time>,
    respite: Respite,
    outputs: VecDeque<Output>,
    /// The output that was taken last, if it is one that is said once.
    in_hand: Option<Output>,
    /// Which of the post's events was taken in last, and which input of it.
    taken_in: Place,
    sequence: u64,
}

/// Which of the post's events, counted from 1, and which input that comes of it.
pub(crate) type Place = (u64, u32);

impl Output {
    /// Whether nobody asks for it again: in the hand of an actor that failed it would be lost.
    fn is_said_once(&self) -> bool {
        matches!(
            self,
            Self::AnswerBarrier { .. }
                | Self::Release { .. }
                | Self::Tell { .. }
                | Self::TellDirectory { .. }
        )
    }
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
            own_groups: 0,
            peers: Peers::new(config.ndl.nodes_max),
            rendezvous: Rendezvous::new(node, incarnation, config.payload_max),
            phases: Phases::default(),
            undelivered: Undelivered::default(),
            watchers: Watchers::default(),
            seen: BTreeSet::new(),
            cycles: BTreeSet::new(),
            same_names: BTreeSet::new(),
            has_changed: false,
            version: 1,
            encoded: None,
            spacing: Duration::ZERO,
            not_taken: BTreeSet::new(),
            retry: None,
            respite: Respite::default(),
            outputs: VecDeque::new(),
            in_hand: None,
            taken_in: (0, 0),
            sequence: 0,
        }
    }

    /// Takes in what has happened, unless this was done before. An event in the hand of an actor that failed is handed to its successor too,
    /// and this core is both actors': an arrival that was counted again would open the next round in its application's absence.
    pub(crate) fn handle_once(&mut self, now: Time, place: Place, input: Input) {
        if place > self.taken_in {
            self.handle(now, input);
            self.taken_in = place;
        }
    }

    /// Takes in what has happened.
    pub(crate) fn handle(&mut self, now: Time, input: Input) {
        match input {
            Input::AppChanged(fact) => self.app_changed(now, fact),
            Input::GroupsChanged(published) => self.groups_changed(now, published),
            Input::MembershipChanged(fact) => self.membership_changed(fact),
            Input::Arrived { app, correlation, asked } => self.arrived(now, app, correlation, asked),
            Input::Left { app, barrier, correlation } => {
                self.rendezvous.leave(now, app, &barrier, correlation);
                self.phases.leave(app, &barrier, correlation);
            }
            Input::AnswerNotTaken { app, correlation, answer } => {
                return self.answer_not_taken(now, app, correlation, answer);
            }
            Input::ArrivalsReceived { from, payload } => self.arrivals_received(now, from, &payload),
            Input::ListNotTaken { to } => return self.peers.not_taken(now, to),
            Input::ArrivalsNotTaken { to } => self.rendezvous.not_taken(now, to),
            Input::LinkChanged(fact) => self.link_changed(now, fact),
            Input::ListReceived { from, payload } => self.list_received(from, &payload),
            Input::DirectoryWanted { app } => self.watchers.add(app),
            Input::DirectoryNotTaken { app, event } => return self.directory_not_taken(now, app, event),
            Input::ReleaseNotTaken { app } => self.release_not_taken(now, app),
            Input::EventNotTaken { app, name } => self.keep(now, app, Some(name)),
            Input::TimePassed => {}
        }
        self.offer_again(now);
        self.answer_again(now);
        // First of all who is farther away: what applications of this node do when they are let go takes the processor that would tell the others.
        self.publish(now);
        let moment = self.respite.moment(now);
        self.evaluate(moment);
        self.report_overdue(moment);
        self.report_misspelt(moment);
        self.meet(moment);
        self.tell_watchers(now);
    }

    /// Whether since the last question somebody came into the directory, went out of it, or is there otherwise. Who has a copy of it makes a new
    /// one, so what only repeats what is known must not say so.
    pub(crate) fn take_directory_changed(&mut self) -> bool {
        std::mem::take(&mut self.has_changed)
    }

    /// The next thing to be done; take until there is none.
    pub(crate) fn poll(&mut self) -> Option<Output> {
        let output = self.outputs.pop_front();
        self.in_hand = output.as_ref().filter(|output| output.is_said_once()).cloned();
        output
    }

    /// The actor that took the last output was replaced. Whether it carried that out is not known, and nobody asks twice: an answer about a barrier
    /// is given again, and who has it counts the second one as a late reply; what else is said once counts as not taken.
    pub(crate) fn replaced(&mut self, now: Time) {
        match self.in_hand.take() {
            Some(answer @ Output::AnswerBarrier { .. }) => self.outputs.push_front(answer),
            Some(Output::Release { app }) => self.release_not_taken(now, app),
            Some(Output::Tell { app, event, .. }) => self.keep(now, app, Some(event.name().to_owned())),
            Some(Output::TellDirectory { app, event }) => self.directory_not_taken(now, app, event),
            Some(_) | None => {}
        }
    }

    /// When to come back with [`Input::TimePassed`].
    pub(crate) fn next_wake(&self) -> Option<Time> {
        let overdue = self.apps.waiting().map(|(_, _, wait)| wait.overdue).min();
        let silent =
            self.apps.iter().flat_map(|(_, app)| app.silent.values().chain(&app.patience).copied()).min();
        let judged =
            [overdue, self.next_misspelt(), silent, self.rendezvous.next_over(), self.phases.next_wake()];
        let judged = judged.into_iter().flatten().min().map(|over| self.respite.judges(over));
        [
            judged,
            self.peers.next_due(),
            self.retry,
            self.rendezvous.next_due(),
            self.undelivered.next_wake(),
            self.watchers.next_wake(),
        ]
        .into_iter()
        .flatten()
        .min()
    }

    /// The TIDs of the applications called `name`: of this node first, ready or not, so that what a node sends to a name of its own never goes to
    /// another's; then who is ready, then who is on a linked node, and then the lowest address. spec: SYNC-6
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
            waits: app
                .wait()
                .map(|wait| now.since(wait.since))
                .or_else(|| Some(self.lacks_at_phases(now, address)?.0)),
            ended: app.ended.map(|ended| Reason::from(ended).words()),
            kinds: app.kinds.clone(),
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

    /// What this application lacks of what it requires, since when and why: what it waits for or, when it runs, what it was told is lost; and who
    /// has not reached a phase at which it waits.
    pub(crate) fn missing(&self, now: Time, address: AppAddress) -> Vec<Absence> {
        if let Some(waiting) = self.wait_of(now, address) {
            return waiting.missing;
        }
        let Some(app) = self.apps.get(address) else { return Vec::new() };
        let lost = app.requires.iter().filter(|requirement| app.lost.contains(requirement.as_str()));
        let lost = lost.flat_map(|requirement| self.absences(now, address, requirement));
        lost.chain(self.lacks_at_phases(now, address).into_iter().flat_map(|(_, missing)| missing)).collect()
    }

    fn refuse(&mut self, cause: &'static str, detail: String) {
        self.outputs.push_back(Output::Refused { cause, detail });
    }
}
