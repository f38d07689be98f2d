//! The facts that are written beside messages: found by comparing the node's state with that of the last look.

use std::{
    collections::{BTreeMap, BTreeSet},
    sync::Arc,
    time::Duration,
};

use sinew_model::{facts::LossReason, leave_reason::LeaveReason};
use sinew_record::{Channel, ClockFact, Fact, LogFact, NodeFact, PeerClock, fact};
use sinew_runtime::{
    lock,
    log::{LogObserver, tracing::Level},
    supervision::{ActorRestart, RestartObserver},
    tid::{Incarnation, NodeAddress, Tid},
    time::Time,
};
use sinew_shm::journal::Journal;

use super::plan::Trigger;
use crate::NodeState;

/// Time between two records of the clocks.
const CLOCK_PERIOD: Duration = Duration::from_secs(1);
/// Maximum number of facts of one look; the next one finds the others.
const FACTS_MAX: usize = 1_024;

/// The state of the last look.
#[derive(Debug, Default)]
pub(super) struct KnownFacts {
    nodes: BTreeMap<(NodeAddress, Incarnation), String>,
    apps: BTreeMap<(Tid, String), bool>,
    barriers: BTreeMap<String, (u64, Vec<String>, Vec<String>)>,
    clocks_due: Time,
}

/// Writes a fact.
pub(super) fn write<F: Fact>(journal: &Journal, node: NodeAddress, now: Time, of: &F) {
    journal.write(Channel::of_node(node, F::FORM).key(), now.as_nanos(), &[&fact(of)]);
}

/// Writes the trigger into the journal, so that it is an event of the span.
pub(super) fn write_trigger(state: &NodeState, journal: &Journal, trigger: &Trigger) {
    let (id, cause) = (trigger.id.to_string(), trigger.cause.as_str().to_owned());
    let fact = NodeFact::Triggered { id, cause, bound_ns: trigger.bound_ns };
    write(journal, state.ctx.node, Time::from_nanos(trigger.at_ns), &fact);
}

/// Writes each event of the process's log, and each restart.
pub(super) struct FactWriter {
    pub(super) node: NodeAddress,
    pub(super) journal: Arc<Journal>,
}

impl RestartObserver for FactWriter {
    fn restarted(&self, restart: &ActorRestart<'_>) {
        let ActorRestart { name, supervisor, tid, restarts, why } = *restart;
        // Other nodes of this process have writers of their own. Layers have no address: each node has their restarts.
        if tid.is_some_and(|tid| tid.node != self.node) {
            return;
        }
        let fact = NodeFact::Restarted {
            node: self.node,
            app: tid.map(|tid| tid.app),
            name: name.to_owned(),
            supervisor: supervisor.to_owned(),
            restarts,
            why: LeaveReason::of(why).as_str().to_owned(),
        };
        write(&self.journal, self.node, Time::now(), &fact);
    }
}

impl LogObserver for FactWriter {
    fn wrote(&self, level: Level, target: &str, text: &str) {
        let line = LogFact {
            level: level.as_str().to_ascii_lowercase(),
            target: target.to_owned(),
            text: text.to_owned(),
        };
        write(&self.journal, self.node, Time::now(), &line);
    }
}

/// The changes that a look found.
#[derive(Debug, Default)]
pub(super) struct Changes {
    /// The nodes that were lost without an announcement, as text.
    pub(super) losses: Vec<String>,
    /// Whether an application has a new name, or has lost one.
    pub(super) has_new_names: bool,
}

impl KnownFacts {
    /// Writes the changes since the last look, and once a second the clocks.
    pub(super) fn look(&mut self, state: &NodeState, journal: &Journal, now: Time) -> Changes {
        let mut facts = Vec::new();
        let losses = self.look_at_nodes(state, &mut facts);
        self.look_at_apps(state, &mut facts);
        self.look_at_barriers(state, now, &mut facts);
        for of in &facts {
            write(journal, state.ctx.node, now, of);
        }
        if now >= self.clocks_due {
            self.clocks_due = now + CLOCK_PERIOD;
            let wall_offset_ns = super::wall_offset();
            journal.set_wall_offset(wall_offset_ns);
            write(journal, state.ctx.node, now, &ClockFact { wall_offset_ns, peers: clocks(state, now) });
        }
        let is_name = |of: &NodeFact| matches!(of, NodeFact::AppNamed { .. } | NodeFact::AppGone { .. });
        Changes { losses, has_new_names: facts.iter().any(is_name) }
    }

    fn look_at_nodes(&mut self, state: &NodeState, facts: &mut Vec<NodeFact>) -> Vec<String> {
        let mut losses = Vec::new();
        let Some(members) = state.ctx.ports.members() else { return losses };
        let present: BTreeMap<_, _> = members
            .present()
            .into_iter()
            .map(|member| ((member.node, member.incarnation), member.name))
            .collect();
        let mut lost = None;
        for ((node, incarnation), name) in &self.nodes {
            if !present.contains_key(&(*node, *incarnation)) {
                let lost = lost.get_or_insert_with(|| members.lost());
                let why = lost.iter().find(|lost| (lost.node, lost.incarnation) == (*node, *incarnation));
                let has_left = why.is_some_and(|lost| matches!(lost.why, LossReason::Left));
                let why = why.map_or_else(String::new, |lost| lost.why.to_string());
                if !has_left {
                    let detail = if why.is_empty() { "it is there again" } else { &why };
                    losses.push(format!("the node {name} at {node} is lost: {detail}"));
                }
                let (node, name, incarnation) = (*node, name.clone(), *incarnation);
                facts.push(NodeFact::NodeLost { node, name, incarnation, why });
            }
        }
        for ((node, incarnation), name) in &present {
            if !self.nodes.contains_key(&(*node, *incarnation)) {
                let (node, name, incarnation) = (*node, name.clone(), *incarnation);
                facts.push(NodeFact::NodeFound { node, name, incarnation });
            }
        }
        self.nodes = present;
        losses
    }

    fn look_at_apps(&mut self, state: &NodeState, facts: &mut Vec<NodeFact>) {
        let Some(names) = state.ctx.ports.names() else { return };
        let directory: BTreeMap<_, _> =
            names.directory().into_iter().map(|entry| ((entry.tid, entry.name), entry.ready)).collect();
        let gone: Vec<_> = self
            .apps
            .keys()
            .filter(|known| !directory.contains_key(*known))
            .take(FACTS_MAX)
            .cloned()
            .collect();
        for (tid, name) in gone {
            self.apps.remove(&(tid, name.clone()));
            facts.push(NodeFact::AppGone { node: tid.node, app: tid.app, name });
        }
        for ((tid, name), is_ready) in directory {
            if facts.len() >= FACTS_MAX {
                break;
            }
            if self.apps.insert((tid, name.clone()), is_ready) != Some(is_ready) {
                facts.push(NodeFact::AppNamed { node: tid.node, app: tid.app, name, is_ready });
            }
        }
    }

    fn look_at_barriers(&mut self, state: &NodeState, now: Time, facts: &mut Vec<NodeFact>) {
        let statuses = lock(&state.sync.core).barriers(now);
        let mut present = BTreeSet::new();
        for status in statuses.into_iter().take(FACTS_MAX) {
            let waiting: Vec<_> = status.waiting.into_iter().map(|(name, _)| name).collect();
            let missing: Vec<_> = status.missing.into_iter().map(|absence| absence.name).collect();
            let (name, generation) = (status.barrier, status.generation);
            present.insert(name.clone());
            let is_new = |known: Option<&(u64, Vec<String>, Vec<String>)>| {
                known.is_none_or(|known| (known.0, &known.1, &known.2) != (generation, &waiting, &missing))
            };
            if is_new(self.barriers.get(&name)) {
                self.barriers.insert(name.clone(), (generation, waiting.clone(), missing.clone()));
                facts.push(NodeFact::Barrier { name, generation, waiting, missing });
            }
        }
        let over: Vec<_> = self.barriers.keys().filter(|name| !present.contains(*name)).cloned().collect();
        for name in over {
            let generation = self.barriers.remove(&name).map_or(0, |known| known.0);
            let (waiting, missing) = (Vec::new(), Vec::new());
            facts.push(NodeFact::Barrier { name, generation, waiting, missing });
        }
    }
}

/// Returns the clocks of all nodes that are present.
pub(crate) fn clocks(state: &NodeState, now: Time) -> Vec<PeerClock> {
    let present = state.ctx.ports.members().map(|members| members.present()).unwrap_or_default();
    let clock = |member: sinew_model::ports::Member| {
        let offset = state.ctx.clocks.get(member.node, member.incarnation)?.at(now);
        Some(PeerClock {
            node: member.node,
            incarnation: member.incarnation,
            theirs_minus_ours_ns: offset.theirs_minus_ours_ns,
            bound_ns: u64::try_from(offset.bound.as_nanos()).unwrap_or(u64::MAX),
            drift_ppb: offset.drift.ppb,
            drift_bound_ppb: offset.drift.bound_ppb,
        })
    };
    present.into_iter().filter_map(clock).collect()
}
