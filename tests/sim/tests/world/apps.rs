//! The applications. Each registers, starts when the sync manager releases it, and may fail. Each member
//! meets the others at a barrier.

use std::time::Duration;

use sinew_model::{
    barrier::{ArriveAtBarrier, BarrierAnswer, BarrierKind, OnPartyLoss},
    events::SyncEvent,
    facts::AppFact,
};
use sinew_runtime::{
    app::RequirementEvent,
    tid::{AppAddress, Tid},
    wire::{Flags, Message},
};

use crate::{
    Fault,
    plan::{NODES, Plan},
    world::{Event, World},
};

/// The application of each node that members require.
const BASE: usize = 0;
/// The application of each node that meets the others.
pub(crate) const MEMBER: usize = 1;
/// The application of each node that requires a member.
const TOP: usize = 2;

const BARRIER: &str = "all";
/// Longer than a run.
const WITHIN_MS: u32 = 60_000;

#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Stage {
    Waiting,
    Starting,
    Ready,
}

/// An application of a process.
#[derive(Clone, Debug)]
pub(crate) struct App {
    pub(crate) name: String,
    pub(crate) requires: Vec<String>,
    pub(crate) incarnation: u64,
    pub(crate) stage: Stage,
    /// The number of the request that waits at the barrier.
    pub(crate) waits: Option<u64>,
    requests: u64,
}

impl App {
    /// Returns the applications of a node.
    pub(crate) fn all_of(plan: &Plan, node: usize) -> Vec<Self> {
        let app = |name, requires| Self {
            name,
            requires,
            incarnation: 0,
            stage: Stage::Waiting,
            waits: None,
            requests: 0,
        };
        let bases = plan.requires[node].iter().map(|node| name(BASE, *node)).collect();
        vec![
            app(name(BASE, node), Vec::new()),
            app(name(MEMBER, node), bases),
            app(name(TOP, node), vec![name(MEMBER, (node + 1) % NODES)]),
        ]
    }
}

/// Returns the name of an application; its node is behind the dot.
fn name(slot: usize, node: usize) -> String {
    format!("{}.{node}", ["base", "member", "top"][slot])
}

/// Returns the node of the application of this name.
pub(crate) fn node_of_name(name: &str) -> usize {
    name.split_once('.').and_then(|(_, node)| node.parse().ok()).expect("each name has its node")
}

fn address(slot: usize) -> AppAddress {
    let slot = u32::try_from(slot).expect("few applications");
    AppAddress::fixed(slot).expect("small numbers are valid")
}

fn slot_of(app: AppAddress) -> usize {
    (0..=TOP).find(|slot| address(*slot) == app).expect("only these are registered")
}

impl World {
    pub(crate) fn register_apps(&mut self, process: usize) {
        for slot in 0..=TOP {
            let App { name, requires, .. } = self.processes[process].apps[slot].clone();
            let app = address(slot);
            self.app_changed(process, AppFact::own_registered(app, Some(name), requires));
            if self.fault == Some(Fault::ReadyBeforeRelease) {
                self.app_changed(process, AppFact::Ready { app });
            }
        }
    }

    /// The sync manager releases an application.
    pub(crate) fn release(&mut self, process: usize, app: AppAddress) {
        let slot = slot_of(app);
        let app = self.processes[process].apps[slot].clone();
        self.note(process, || format!("{} is released", app.name));
        self.coverage.count("releases");
        let words = self.judge.released(process, &app);
        self.judge.violations.extend(words);
        if self.fault == Some(Fault::ReleaseOfNextLifeLost) && app.incarnation > 0 {
            return;
        }
        self.processes[process].apps[slot].stage = Stage::Starting;
        let delay = self.chance.between(Duration::from_millis(1), Duration::from_millis(20));
        self.queue.push_after(delay, Event::Starts { process, slot, incarnation: app.incarnation });
    }

    /// A released application has started.
    pub(crate) fn app_starts(&mut self, process: usize, slot: usize, incarnation: u64) {
        let app = &mut self.processes[process].apps[slot];
        if (app.stage, app.incarnation) != (Stage::Starting, incarnation) {
            return;
        }
        app.stage = Stage::Ready;
        let name = app.name.clone();
        self.judge.became_ready(self.queue.now(), name);
        self.app_changed(process, AppFact::Ready { app: address(slot) });
        if slot == MEMBER {
            let delay = self.chance.between(Duration::ZERO, Duration::from_millis(10));
            self.queue.push_after(delay, Event::Arrives { process });
        }
    }

    /// The member of a process arrives at the barrier, unless it waits there.
    pub(crate) fn member_arrives(&mut self, process: usize) {
        let on_loss = if self.plan.fails_on_loss { OnPartyLoss::Fail } else { OnPartyLoss::Wait };
        let here = self.processes[process].address;
        let app = &mut self.processes[process].apps[MEMBER];
        if app.stage != Stage::Ready || app.waits.is_some() {
            return;
        }
        app.requests += 1;
        app.waits = Some(app.requests);
        let asked = ArriveAtBarrier {
            barrier: BARRIER.to_owned(),
            parties: (0..NODES).map(|node| name(MEMBER, node)).collect(),
            within_ms: WITHIN_MS,
            on_loss,
            kind: BarrierKind::Meeting,
        };
        let ends = (Tid::new(here, address(MEMBER)), Tid::new(here, AppAddress::SYNC));
        let mut message = Message::typed(ends.0, ends.1, &asked);
        (message.header.flags, message.header.correlation) = (Flags::ASK, app.requests);
        let app = app.clone();
        self.note(process, || format!("{} arrives", app.name));
        self.judge.arrived(process, &app);
        self.post_sync(process, SyncEvent::Message(message));
    }

    pub(crate) fn barrier_answered(
        &mut self,
        process: usize,
        app: AppAddress,
        correlation: u64,
        answer: &BarrierAnswer,
    ) {
        let app = &mut self.processes[process].apps[slot_of(app)];
        if app.waits != Some(correlation) {
            // It was for an incarnation that has ended.
            return;
        }
        app.waits = None;
        let app = app.clone();
        self.note(process, || format!("{} is answered {answer:?}", app.name));
        let now = self.queue.now();
        match answer {
            BarrierAnswer::Opened { generation } => {
                self.coverage.count("openings");
                self.forget_unknown_openings(process, *generation);
                let words = self.judge.opened(now, process, &app, *generation);
                self.judge.violations.extend(words);
            }
            BarrierAnswer::Lost { .. } if self.plan.fails_on_loss => {
                self.coverage.count("parties lost");
                self.judge.stopped_waiting(now, process, &app);
            }
            BarrierAnswer::Lost { .. } | BarrierAnswer::TimedOut { .. } | BarrierAnswer::Refused { .. } => {
                self.judge.violate(format!("{} is answered {answer:?}", app.name));
            }
        }
    }

    /// Forgets passings of a generation by nodes that have ended, unless another node knows of it: nobody can repeat
    /// what has ended with the only node that knew.
    fn forget_unknown_openings(&mut self, process: usize, generation: u64) {
        let knows = |other: &usize| {
            let barriers = self.processes[*other].sync.barriers(self.local(*other));
            barriers.iter().any(|barrier| barrier.generation >= generation)
        };
        if !self.running().iter().filter(|other| **other != process).any(knows) {
            self.judge.forget_openings_of_ended(generation);
        }
    }

    pub(crate) fn requirement_changed(&mut self, process: usize, app: AppAddress, event: &RequirementEvent) {
        let app = self.processes[process].apps[slot_of(app)].clone();
        self.note(process, || format!("{} is notified of {event:?}", app.name));
        let is_lost = !matches!(event, RequirementEvent::Met { .. });
        self.coverage.count(if is_lost { "requirements lost" } else { "requirements met" });
        let is_reachable = is_lost && self.has_been_reachable(process, event.name());
        let words = self.judge.notified(process, &app, event, is_reachable);
        self.judge.violations.extend(words);
    }

    /// Returns whether an application has been ready, and its node linked, for longer than any report takes.
    fn has_been_reachable(&self, process: usize, name: &str) -> bool {
        let node = node_of_name(name);
        let (now, here) = (self.queue.now(), self.node_of(process));
        let since = now - Duration::from_millis(600);
        let is_linked = self.judge.was_linked_since(process, node, since);
        let is_near = node == here || is_linked && !self.judge.is_troubled(now, here, node);
        let stays = self.current(node).is_some_and(|process| !self.processes[process].is_leaving);
        is_near && stays && self.judge.was_ready_since(name, since)
    }

    /// The applications of a process stop because their node does. They do not start again.
    pub(crate) fn stop_apps(&mut self, process: usize) {
        let now = self.queue.now();
        for slot in 0..=TOP {
            let app = &mut self.processes[process].apps[slot];
            let ended = app.clone();
            (app.stage, app.waits) = (Stage::Waiting, None);
            app.incarnation += 1;
            self.judge.app_ended(now, process, &ended);
        }
    }

    /// An application fails, and waits for its next release.
    pub(crate) fn app_fails(&mut self, process: usize, slot: usize) {
        let app = &mut self.processes[process].apps[slot];
        if app.stage == Stage::Waiting {
            return;
        }
        let ended = app.clone();
        (app.stage, app.waits) = (Stage::Waiting, None);
        app.incarnation += 1;
        self.coverage.count("failures");
        self.judge.app_ended(self.queue.now(), process, &ended);
        self.app_changed(process, AppFact::Down { app: address(slot) });
    }
}
