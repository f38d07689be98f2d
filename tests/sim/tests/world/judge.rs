//! The rules that must hold always. The judge knows the true state.

use std::{
    collections::{BTreeMap, BTreeSet},
    time::Duration,
};

use sinew_model::facts::{LinkFact, LossReason, MembershipFact};
use sinew_runtime::{
    app::RequirementEvent,
    tid::{Incarnation, NodeAddress},
    time::Time,
    wire::Header,
};

use crate::{apps::App, world::number_of};

/// Time after the last trouble within which a node may still be lost: the bound of a loss, and the time of a
/// grace period.
const LOSS_MAX: Duration = Duration::from_millis(700);
/// Time within which each layer has read an event, with all events before it.
const TOLD_MAX: Duration = Duration::from_millis(100);
/// Time for which an ended wait may still be counted by others: more than a partition lasts.
const COUNTED_MAX: Duration = Duration::from_secs(4);

/// An incarnation of a node.
#[derive(Clone, Copy, Debug)]
struct IncarnationState {
    process: usize,
    has_ended: bool,
    has_left: bool,
}

/// A wait at the barrier.
#[derive(Clone, Debug)]
struct Arrival {
    process: usize,
    party: String,
    incarnation: u64,
    outcome: Wait,
}

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Wait {
    Pending,
    Passed(u64),
    /// It has passed a generation of which only its node knew, and that has ended.
    Forgotten(u64),
    Over(Time),
}

#[derive(Debug, Default)]
pub(crate) struct Judge {
    pub(crate) violations: Vec<String>,
    incarnations: BTreeMap<(NodeAddress, Incarnation), IncarnationState>,
    /// The incarnation of a node that a process's NDL, or its sync manager, holds for present.
    members: BTreeMap<(usize, NodeAddress), Incarnation>,
    synced: BTreeMap<(usize, NodeAddress), Incarnation>,
    /// Incarnations that a process has lost, of which it may receive nothing.
    lost: BTreeSet<(usize, NodeAddress, Incarnation)>,
    ever_lost: BTreeSet<(usize, NodeAddress, Incarnation)>,
    /// When a process's NDL lost a node that it has not found again.
    absent: BTreeMap<(usize, NodeAddress), Time>,
    /// The links that a process's sync manager was told of.
    synced_links: BTreeMap<(usize, NodeAddress), Incarnation>,
    /// The last frame of an incarnation that a process's sync manager received.
    frames: BTreeMap<(usize, NodeAddress), (Incarnation, u64)>,
    /// Since when a process has a link to a node.
    links: BTreeMap<(usize, NodeAddress), Time>,
    /// Pairs of nodes with trouble between them; until when, if it has ended.
    troubles: BTreeMap<(usize, usize), Option<Time>>,
    released: BTreeSet<(usize, String, u64)>,
    has_run: BTreeSet<String>,
    ready_since: BTreeMap<String, Time>,
    /// The requirements that an application of a process was told to be lost.
    notified_lost: BTreeMap<(usize, String), BTreeSet<String>>,
    arrivals: Vec<Arrival>,
}

fn pair(one: usize, other: usize) -> (usize, usize) {
    (one.min(other), one.max(other))
}

impl Judge {
    pub(crate) fn violate(&mut self, words: String) {
        self.violations.push(words);
    }

    pub(crate) fn started(&mut self, process: usize, node: NodeAddress, incarnation: Incarnation) {
        self.incarnations
            .insert((node, incarnation), IncarnationState { process, has_ended: false, has_left: false });
    }

    fn state_of(&mut self, process: usize) -> &mut IncarnationState {
        self.incarnations
            .values_mut()
            .find(|state| state.process == process)
            .expect("each process has started")
    }

    pub(crate) fn ended(&mut self, process: usize) {
        self.state_of(process).has_ended = true;
    }

    pub(crate) fn left(&mut self, process: usize) {
        self.state_of(process).has_left = true;
    }

    pub(crate) fn has_left_before(&self, node: NodeAddress, incarnation: Incarnation) -> bool {
        self.incarnations
            .iter()
            .any(|((of, former), state)| *of == node && *former < incarnation && state.has_left)
    }

    pub(crate) fn has_lost_former(
        &self,
        process: usize,
        node: NodeAddress,
        incarnation: Incarnation,
    ) -> bool {
        self.ever_lost.iter().any(|(by, of, former)| (*by, *of) == (process, node) && *former < incarnation)
    }

    pub(crate) fn troubled(&mut self, one: usize, other: usize) {
        self.troubles.insert(pair(one, other), None);
    }

    pub(crate) fn mended(&mut self, now: Time, one: usize, other: usize) {
        self.troubles.insert(pair(one, other), Some(now));
    }

    pub(crate) fn all_mended(&mut self, now: Time) {
        self.troubles.values_mut().for_each(|until| _ = until.get_or_insert(now));
    }

    /// Returns whether there was trouble between two nodes so lately that it may still be reported.
    pub(crate) fn is_troubled(&self, now: Time, one: usize, other: usize) -> bool {
        let trouble = self.troubles.get(&pair(one, other));
        trouble.is_some_and(|until| until.is_none_or(|until| until + LOSS_MAX > now))
    }

    pub(crate) fn link_changed(&mut self, now: Time, process: usize, fact: &LinkFact) {
        match fact {
            LinkFact::LinkUp { node, .. } => {
                self.links.entry((process, *node)).or_insert(now);
            }
            LinkFact::LinkBroken { node, .. } | LinkFact::PeerLeft { node, .. } => {
                self.links.remove(&(process, *node));
            }
            LinkFact::DialRefused { .. } => {}
        }
    }

    pub(crate) fn was_linked_since(&self, process: usize, node: usize, since: Time) -> bool {
        let address = crate::world::node_address(node);
        self.links.get(&(process, address)).is_some_and(|at| *at <= since)
    }

    pub(crate) fn was_ready_since(&self, name: &str, since: Time) -> bool {
        self.ready_since.get(name).is_some_and(|at| *at <= since)
    }

    /// NDL of a process reports a change: each incarnation is found, then lost, and only with a cause.
    pub(crate) fn member_changed(
        &mut self,
        now: Time,
        process: usize,
        fact: &MembershipFact,
    ) -> Option<String> {
        match fact {
            MembershipFact::NodeFound { node, incarnation, .. } => {
                if !self.incarnations.contains_key(&(*node, *incarnation)) {
                    return Some(format!("process {process} found {node} in {incarnation}, which never was"));
                }
                self.absent.remove(&(process, *node));
                let former = self.members.insert((process, *node), *incarnation);
                former.map(|former| format!("process {process} found {node}, and has not lost {former}"))
            }
            MembershipFact::NodeLost { node, incarnation, why } => {
                self.ever_lost.insert((process, *node, *incarnation));
                if !why.is_announced() {
                    self.absent.insert((process, *node), now);
                }
                let former = self.members.remove(&(process, *node));
                if former != Some(*incarnation) {
                    return Some(format!(
                        "process {process} lost {node} in {incarnation} twice: it had {former:?}"
                    ));
                }
                self.check_cause(now, process, (*node, *incarnation), why)
            }
        }
    }

    /// GNCL dials a node: not one that NDL has lost, once it was told so.
    pub(crate) fn dials(&self, now: Time, process: usize, node: NodeAddress) -> Option<String> {
        let lost = self.absent.get(&(process, node))?;
        (*lost + TOLD_MAX < now)
            .then(|| format!("process {process} dials {node}, which it lost {:?} ago", now.since(*lost)))
    }

    fn check_cause(
        &self,
        now: Time,
        process: usize,
        (node, incarnation): (NodeAddress, Incarnation),
        why: &LossReason,
    ) -> Option<String> {
        let state = self.incarnations.get(&(node, incarnation))?;
        let here = self.incarnations.iter().find(|(_, state)| state.process == process)?.0.0;
        let is_near = self.is_troubled(now, number_of(here), number_of(node));
        // A connection that stands shows that the node runs.
        let is_unlinked = self.links.get(&(process, node)).is_none_or(|since| *since + LOSS_MAX > now);
        let is_caused = match why {
            LossReason::Left | LossReason::GaveUp(_) => state.has_left,
            LossReason::Crashed => state.has_ended,
            LossReason::Hung | LossReason::LinkDown => {
                state.has_ended || state.has_left || is_near || is_unlinked
            }
            LossReason::Restarted => state.has_ended,
            LossReason::Duplicate => false,
        };
        (!is_caused)
            .then(|| format!("process {process} lost {node} in {incarnation} ({why:?}) without a cause"))
    }

    /// The sync manager of a process is told of a change.
    pub(crate) fn sync_was_told(&mut self, process: usize, fact: &MembershipFact) -> Option<String> {
        match *fact {
            MembershipFact::NodeFound { node, incarnation, .. } => {
                self.synced.insert((process, node), incarnation);
                self.lost.remove(&(process, node, incarnation));
                None
            }
            MembershipFact::NodeLost { node, incarnation, ref why } => {
                if !why.is_announced() {
                    self.lost.insert((process, node, incarnation));
                }
                let present = self.synced.remove(&(process, node));
                (present != Some(incarnation))
                    .then(|| format!("the sync manager of {process} is notified twice that {node} is lost"))
            }
        }
    }

    /// The sync manager of a process is told of a link: each is broken before it is established again.
    pub(crate) fn sync_was_told_of_a_link(&mut self, process: usize, fact: &LinkFact) -> Option<String> {
        match *fact {
            LinkFact::LinkUp { node, incarnation } => {
                // Frames of a former incarnation are too late from now on.
                let last = self.frames.entry((process, node)).or_insert((incarnation, 0));
                *last = (*last).max((incarnation, 0));
                let former = self.synced_links.insert((process, node), incarnation);
                (former == Some(incarnation))
                    .then(|| format!("the sync manager of {process} is notified of two links to {node}"))
            }
            LinkFact::LinkBroken { node, .. } | LinkFact::PeerLeft { node, .. } => {
                self.synced_links.remove(&(process, node));
                None
            }
            LinkFact::DialRefused { .. } => None,
        }
    }

    /// The sync manager of a process receives a frame: none of a lost incarnation, each once and in order.
    pub(crate) fn frame_of_a_node(&mut self, process: usize, header: &Header) -> Option<String> {
        let (node, incarnation) = (header.source.node, Incarnation(header.correlation));
        if self.lost.contains(&(process, node, incarnation)) {
            return Some(format!(
                "process {process} takes a frame of {node} in {incarnation}, which it has lost"
            ));
        }
        let now = (incarnation, header.sequence);
        let last = self.frames.insert((process, node), now);
        let is_in_order = last.is_none_or(|last| last.0 < now.0 || last.0 == now.0 && last.1 < now.1);
        (!is_in_order).then(|| format!("process {process} takes {now:?} of {node} after {last:?}"))
    }

    /// A correct peer was refused for its frames.
    pub(crate) fn violated(&mut self, process: usize, node: NodeAddress, words: &str) {
        self.violate(format!("process {process} refuses a frame of {node}: {words}"));
    }

    /// An application is released: once in each incarnation, and after all that it requires has run.
    pub(crate) fn released(&mut self, process: usize, app: &App) -> Option<String> {
        let App { name, requires, incarnation, .. } = app;
        if !self.released.insert((process, name.clone(), *incarnation)) {
            return Some(format!(
                "{name} is released twice in incarnation {incarnation} of process {process}"
            ));
        }
        let early = requires.iter().find(|required| !self.has_run.contains(*required))?;
        Some(format!("{name} is released before {early} has run"))
    }

    pub(crate) fn became_ready(&mut self, now: Time, name: String) {
        self.has_run.insert(name.clone());
        self.ready_since.insert(name, now);
    }

    /// An incarnation of an application ends, with its wait at the barrier.
    pub(crate) fn app_ended(&mut self, now: Time, process: usize, app: &App) {
        self.ready_since.remove(&app.name);
        self.stopped_waiting(now, process, app);
    }

    /// An application is notified of a requirement: lost and met alternate, and nothing reachable is lost.
    pub(crate) fn notified(
        &mut self,
        process: usize,
        app: &App,
        event: &RequirementEvent,
        is_reachable: bool,
    ) -> Option<String> {
        let lost = self.notified_lost.entry((process, app.name.clone())).or_default();
        let is_news = match event {
            RequirementEvent::Lost { name } | RequirementEvent::Without { name } => lost.insert(name.clone()),
            RequirementEvent::Met { name } => lost.remove(name),
        };
        if is_reachable {
            return Some(format!("{} is notified of {event:?}, which is ready and linked", app.name));
        }
        (!is_news).then(|| format!("{} of process {process} is notified of {event:?} twice", app.name))
    }

    /// Returns the lost requirements of which an application was notified.
    pub(crate) fn notified_lost_of(&self, process: usize, app: &App) -> BTreeSet<String> {
        self.notified_lost.get(&(process, app.name.clone())).cloned().unwrap_or_default()
    }

    pub(crate) fn arrived(&mut self, process: usize, app: &App) {
        let (party, incarnation) = (app.name.clone(), app.incarnation);
        self.arrivals.push(Arrival { process, party, incarnation, outcome: Wait::Pending });
    }

    pub(crate) fn stopped_waiting(&mut self, now: Time, process: usize, app: &App) {
        let is_its = |arrival: &&mut Arrival| {
            (arrival.process, &arrival.party, arrival.incarnation) == (process, &app.name, app.incarnation)
                && arrival.outcome == Wait::Pending
        };
        self.arrivals.iter_mut().filter(is_its).for_each(|arrival| arrival.outcome = Wait::Over(now));
    }

    /// No node that runs knows this generation.
    pub(crate) fn forget_openings_of_ended(&mut self, generation: u64) {
        let ended = self.incarnations.values().filter(|state| state.has_ended || state.has_left);
        let ended: BTreeSet<_> = ended.map(|state| state.process).collect();
        let is_it = |arrival: &&mut Arrival| {
            arrival.outcome == Wait::Passed(generation) && ended.contains(&arrival.process)
        };
        self.arrivals
            .iter_mut()
            .filter(is_it)
            .for_each(|arrival| arrival.outcome = Wait::Forgotten(generation));
    }

    /// The barrier opens for an application: each party has arrived for this generation, and each passes it
    /// once.
    pub(crate) fn opened(&mut self, now: Time, process: usize, app: &App, generation: u64) -> Option<String> {
        let last = self.last_generation(&app.name);
        if last.is_some_and(|last| last >= generation) {
            return Some(format!("{} passes generation {generation} after {last:?}", app.name));
        }
        let is_its = |arrival: &&mut Arrival| {
            (arrival.process, &arrival.party, arrival.incarnation) == (process, &app.name, app.incarnation)
                && arrival.outcome == Wait::Pending
        };
        match self.arrivals.iter_mut().find(is_its) {
            Some(arrival) => arrival.outcome = Wait::Passed(generation),
            None => return Some(format!("{} passes, and does not wait", app.name)),
        }
        let counts = |arrival: &Arrival| match arrival.outcome {
            Wait::Pending => true,
            Wait::Passed(passed) | Wait::Forgotten(passed) => passed == generation,
            Wait::Over(at) => at + COUNTED_MAX > now,
        };
        let here: BTreeSet<_> =
            self.arrivals.iter().filter(|arrival| counts(arrival)).map(|arrival| &arrival.party).collect();
        (here.len() < crate::plan::NODES)
            .then(|| format!("generation {generation} opens for {} with {here:?} only", app.name))
    }

    /// Returns the last generation that the application of this name has passed.
    pub(crate) fn last_generation(&self, name: &str) -> Option<u64> {
        let passed = |arrival: &Arrival| match arrival.outcome {
            Wait::Passed(generation) => Some(generation),
            Wait::Pending | Wait::Forgotten(_) | Wait::Over(_) => None,
        };
        self.arrivals.iter().filter(|arrival| arrival.party == name).filter_map(passed).max()
    }
}
