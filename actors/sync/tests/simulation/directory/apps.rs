//! Applications: the requirements and notifications of each life, and its registration, release, start and
//! end.

use sinew_model::barrier::{BarrierKind, OnPartyLoss};

use super::*;

/// An application as its own node's root sees it.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Life {
    pub(super) requires: Vec<Wanted>,
    pub(super) released: u32,
    pub(super) running: bool,
    /// It has reached the phase.
    pub(super) reached: bool,
    /// The start of its wait.
    since: Time,
    /// The missing requirements that it was notified of.
    pub(super) notified: BTreeSet<String>,
    /// The same, with all notifications of earlier lives included.
    pub(super) inherited: BTreeSet<String>,
}

impl Life {
    fn of(requires: Vec<Wanted>, since: Time) -> Self {
        let (notified, inherited) = (BTreeSet::new(), BTreeSet::new());
        Self { requires, released: 0, running: false, reached: false, since, notified, inherited }
    }

    pub(super) const fn state(&self) -> AppState {
        match (self.running, self.reached) {
            (false, _) => AppState::NotRunning,
            (true, false) => AppState::Running,
            (true, true) => AppState::PhaseReached,
        }
    }

    pub(super) fn record(&mut self, event: RequirementEvent) {
        for lacking in [&mut self.notified, &mut self.inherited] {
            match &event {
                RequirementEvent::Lost { name } | RequirementEvent::Without { name } => {
                    lacking.insert(name.clone());
                }
                RequirementEvent::Met { name } => {
                    lacking.remove(name);
                }
            }
        }
    }
}

impl World {
    pub(super) fn life(&mut self, node: usize, app: AppAddress) -> (usize, &mut Life) {
        let slot = (0..SLOTS).find(|slot| app_address(*slot) == app).unwrap();
        (slot, self.apps[node].get_mut(&slot).expect("a release of an unregistered application"))
    }

    /// Returns the state of an application by the reports received over the present link to its node.
    fn received_state(&self, node: usize, index: usize) -> AppState {
        let (peer, slot) = (index / SLOTS, index % SLOTS);
        if peer == node {
            return self.apps[node].get(&slot).map_or(AppState::NotRunning, Life::state);
        }
        self.received.get(&(node, peer)).and_then(|state| state.get(&index)).copied().unwrap_or_default()
    }

    /// Checks a release: all requirements are met, and it is the only one in this life.
    pub(super) fn released(&mut self, node: usize, app: AppAddress) {
        let now = self.now;
        let (slot, life) = self.life(node, app);
        life.released += 1;
        let (released, since, requires) = (life.released, life.since, life.requires.clone());
        let who = format!("{} of node {node}", name(node * SLOTS + slot));
        self.note(|| format!("{who} is released"));
        self.seen.add("released", 1);
        self.violate(released == 1, || format!("{who} is released twice in one life"));
        for wanted in requires {
            let is_met = wanted.is_met_by(self.nodes, |index| self.received_state(node, index));
            let is_done_without = wanted.wait_limit().is_some_and(|limit| since + limit <= now);
            self.seen.add("done without", u64::from(is_done_without && !is_met));
            self.violate(is_met || is_done_without, || {
                format!("{who} is released early: {wanted:?} is not met, by the inputs of its node")
            });
            // The last report may be out of date; it was true once.
            let state = |index: usize| self.furthest.get(&index).copied().unwrap_or_default();
            let has_been = wanted.is_met_by(self.nodes, state);
            self.violate(has_been || is_done_without, || {
                format!("{who} is released early: {wanted:?} has never been met")
            });
        }
    }

    pub(super) fn register(&mut self, node: usize, slot: usize, wanted: Vec<Wanted>) {
        // Requirements point to smaller numbers only, so there is no cycle.
        let index = node * SLOTS + slot;
        let mut requires: Vec<Wanted> = wanted.into_iter().filter_map(|wanted| wanted.below(index)).collect();
        requires.dedup();
        self.seen.add("shared names", u64::from(slot == SHARED));
        // A repeated registration is no new life.
        let former = self.apps[node].get(&slot);
        if former.is_none_or(|life| life.requires != requires) {
            // The wait of an application that already waits counts for the new requirements, too.
            let since = former.filter(|life| life.released == 0).map_or(self.now, |life| life.since);
            self.apps[node].insert(slot, Life::of(requires.clone(), since));
        }
        let requires = requires.iter().map(|wanted| self.spelled(wanted)).collect();
        let address = app_address(slot);
        let fact = AppFact::own_registered(address, Some(name(index)), requires);
        self.feed(node, Input::AppChanged(fact));
        if self.fault == Some(Fault::ReadyTooEarly) {
            self.feed(node, Input::AppChanged(AppFact::Ready { app: address }));
        }
        if self.fault == Some(Fault::ReleasedAtOnce) && self.apps[node][&slot].released == 0 {
            self.released(node, address);
        }
    }

    /// Returns the text of a requirement, as its node receives it.
    fn spelled(&self, wanted: &Wanted) -> String {
        if let (Wanted::Optional { of, .. }, Some(Fault::NotWaitedFor)) = (wanted, self.fault) {
            return Wanted::Optional { of: *of, millis: 1 }.requirement().to_string();
        }
        wanted.requirement().to_string()
    }

    /// Starts a released application. Returns whether it starts.
    pub(super) fn start(&mut self, node: usize, slot: usize) -> bool {
        let life = self.apps[node].get_mut(&slot).filter(|life| life.released == 1 && !life.running);
        let Some(life) = life else { return false };
        life.running = true;
        self.furthest.entry(node * SLOTS + slot).or_insert(AppState::Running);
        self.feed(node, Input::AppChanged(AppFact::Ready { app: app_address(slot) }));
        true
    }

    /// Lets a running application reach the phase, without a wait for others. Returns whether it does.
    pub(super) fn reach(&mut self, node: usize, slot: usize) -> bool {
        let life = self.apps[node].get_mut(&slot).filter(|life| life.running && !life.reached);
        let Some(life) = life else { return false };
        life.reached = true;
        self.seen.add("phases reached", 1);
        let index = node * SLOTS + slot;
        self.furthest.insert(index, AppState::PhaseReached);
        let asked = ArriveAtBarrier {
            barrier: PHASE.to_owned(),
            parties: vec![name(index)],
            within_ms: 1,
            on_loss: OnPartyLoss::Fail,
            kind: BarrierKind::Phase,
        };
        self.feed(node, Input::Arrived { app: app_address(slot), correlation: 1, asked });
        true
    }

    pub(super) fn fail(&mut self, node: usize, slot: usize) {
        let Some(life) = self.apps[node].get_mut(&slot) else { return };
        // A waiting application continues to wait in the same life.
        if life.released == 1 {
            (life.released, life.running, life.reached) = (0, false, false);
            life.since = self.now;
            life.notified.clear();
        }
        if self.fault != Some(Fault::FailureNotReported) {
            self.feed(node, Input::AppChanged(AppFact::Down { app: app_address(slot) }));
        }
    }

    pub(super) fn unregister(&mut self, node: usize, slot: usize) {
        self.apps[node].remove(&slot);
        if self.fault != Some(Fault::EndNotReported) {
            self.feed(node, Input::AppChanged(AppFact::Unregistered { app: app_address(slot) }));
        }
    }
}
