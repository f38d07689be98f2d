//! Applications: what each life of one requires and was told, and how it is registered, released, starts and goes.

use super::*;
use crate::sync::words::{BarrierKind, OnPartyLoss};

/// An application as its own node's root sees it.
#[derive(Clone, Debug, PartialEq)]
pub(super) struct Life {
    pub(super) requires: Vec<Wanted>,
    pub(super) released: u32,
    pub(super) running: bool,
    /// It has reached the phase.
    pub(super) reached: bool,
    /// Since when it waits, or waited.
    since: Time,
    /// What it was told it lacks.
    pub(super) told: BTreeSet<String>,
    /// The same, where all that lives before were told came to this one.
    pub(super) inherited: BTreeSet<String>,
}

impl Life {
    fn of(requires: Vec<Wanted>, since: Time) -> Self {
        let (told, inherited) = (BTreeSet::new(), BTreeSet::new());
        Self { requires, released: 0, running: false, reached: false, since, told, inherited }
    }

    pub(super) const fn come(&self) -> Come {
        match (self.running, self.reached) {
            (false, _) => Come::Nowhere,
            (true, false) => Come::Running,
            (true, true) => Come::Through,
        }
    }

    pub(super) fn hear(&mut self, event: RequirementEvent) {
        for knows in [&mut self.told, &mut self.inherited] {
            match &event {
                RequirementEvent::Lost { name } | RequirementEvent::Without { name } => {
                    knows.insert(name.clone());
                }
                RequirementEvent::Met { name } => {
                    knows.remove(name);
                }
            }
        }
    }
}

impl World {
    pub(super) fn life(&mut self, node: usize, app: AppAddress) -> (usize, &mut Life) {
        let slot = (0..SLOTS).find(|slot| app_address(*slot) == app).unwrap();
        (slot, self.apps[node].get_mut(&slot).expect("a release for who is not registered"))
    }

    /// How far an application has come, by what this node was told since its link to that of the application is up.
    fn heard_of(&self, node: usize, index: usize) -> Come {
        let (peer, slot) = (index / SLOTS, index % SLOTS);
        if peer == node {
            return self.apps[node].get(&slot).map_or(Come::Nowhere, Life::come);
        }
        self.heard.get(&(node, peer)).and_then(|come| come.get(&index)).copied().unwrap_or_default()
    }

    /// No release before all is ready, and one for each life.
    pub(super) fn released(&mut self, node: usize, app: AppAddress) {
        let now = self.now;
        let (slot, life) = self.life(node, app);
        life.released += 1;
        let (released, since, requires) = (life.released, life.since, life.requires.clone());
        let who = format!("{} of node {node}", name(node * SLOTS + slot));
        self.say(|| format!("{who} is released"));
        self.seen.count("released", 1);
        self.violate(released == 1, || format!("{who} is released twice in one life"));
        for wanted in requires {
            let is_met = wanted.is_met_by(self.nodes, |index| self.heard_of(node, index));
            let is_done_without = wanted.patience().is_some_and(|patience| since + patience <= now);
            self.seen.count("done without", u64::from(is_done_without && !is_met));
            self.violate(is_met || is_done_without, || {
                format!("{who} is released early: {wanted:?} is not met, as its node was told")
            });
            // What was heard last may be out of date, and was so once.
            let come = |index: usize| self.has_come.get(&index).copied().unwrap_or_default();
            let has_been = wanted.is_met_by(self.nodes, come);
            self.violate(has_been || is_done_without, || {
                format!("{who} is released early: {wanted:?} has never been so")
            });
        }
    }

    pub(super) fn register(&mut self, node: usize, slot: usize, wanted: Vec<Wanted>) {
        // Requirements point to smaller numbers only, so that there is no cycle.
        let index = node * SLOTS + slot;
        let mut requires: Vec<Wanted> = wanted.into_iter().filter_map(|wanted| wanted.below(index)).collect();
        requires.dedup();
        self.seen.count("shared names", u64::from(slot == SHARED));
        // Told again, it is no new life.
        let former = self.apps[node].get(&slot);
        if former.is_none_or(|life| life.requires != requires) {
            // One that waits already has waited for that, too.
            let since = former.filter(|life| life.released == 0).map_or(self.now, |life| life.since);
            self.apps[node].insert(slot, Life::of(requires.clone(), since));
        }
        let requires = requires.iter().map(|wanted| self.spelled(wanted)).collect();
        let address = app_address(slot);
        let fact = AppFact::own_registered(address, Some(name(index)), requires);
        self.tell(node, Input::AppChanged(fact));
        if self.fault == Some(Fault::ReadyTooEarly) {
            self.tell(node, Input::AppChanged(AppFact::Ready { app: address }));
        }
        if self.fault == Some(Fault::ReleasedAtOnce) && self.apps[node][&slot].released == 0 {
            self.released(node, address);
        }
    }

    /// As its node is told that it is wanted.
    fn spelled(&self, wanted: &Wanted) -> String {
        if let (Wanted::Optional { of, .. }, Some(Fault::NotWaitedFor)) = (wanted, self.fault) {
            return Wanted::Optional { of: *of, millis: 1 }.requirement().to_string();
        }
        wanted.requirement().to_string()
    }

    /// Whether it starts: one that was released.
    pub(super) fn start(&mut self, node: usize, slot: usize) -> bool {
        let life = self.apps[node].get_mut(&slot).filter(|life| life.released == 1 && !life.running);
        let Some(life) = life else { return false };
        life.running = true;
        self.has_come.entry(node * SLOTS + slot).or_insert(Come::Running);
        self.tell(node, Input::AppChanged(AppFact::Ready { app: app_address(slot) }));
        true
    }

    /// Whether it reaches the phase, and waits there for nobody else: one that runs.
    pub(super) fn reach(&mut self, node: usize, slot: usize) -> bool {
        let life = self.apps[node].get_mut(&slot).filter(|life| life.running && !life.reached);
        let Some(life) = life else { return false };
        life.reached = true;
        self.seen.count("phases reached", 1);
        let index = node * SLOTS + slot;
        self.has_come.insert(index, Come::Through);
        let asked = ArriveAtBarrier {
            barrier: PHASE.to_owned(),
            parties: vec![name(index)],
            within_ms: 1,
            on_loss: OnPartyLoss::Fail,
            kind: BarrierKind::Phase,
        };
        self.tell(node, Input::Arrived { app: app_address(slot), correlation: 1, asked });
        true
    }

    pub(super) fn fail(&mut self, node: usize, slot: usize) {
        let Some(life) = self.apps[node].get_mut(&slot) else { return };
        // One that waits goes on waiting in the same life.
        if life.released == 1 {
            (life.released, life.running, life.reached) = (0, false, false);
            life.since = self.now;
            life.told.clear();
        }
        if self.fault != Some(Fault::FailureNotTold) {
            self.tell(node, Input::AppChanged(AppFact::Down { app: app_address(slot) }));
        }
    }

    pub(super) fn unregister(&mut self, node: usize, slot: usize) {
        self.apps[node].remove(&slot);
        if self.fault != Some(Fault::EndNotTold) {
            self.tell(node, Input::AppChanged(AppFact::Unregistered { app: app_address(slot) }));
        }
    }
}
