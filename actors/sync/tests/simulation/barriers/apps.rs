//! Actions of applications: they start, arrive, give up and end.

use super::{waits::Asked, *};

/// The stage of an application.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Stage {
    Unregistered,
    /// Registered, and not ready, or no longer ready.
    Unready,
    Ready,
}

impl World {
    /// Registers all applications of a process, as ready ones.
    pub(super) fn populate(&mut self, node: usize) {
        for app in 0..APPS {
            self.register(node, app);
            self.becomes_ready(node, app);
        }
    }

    fn register(&mut self, node: usize, app: usize) {
        self.stages.insert((node, app), Stage::Unready);
        let (app, name) = (app_address(app), Some(name(self.homes[node], app)));
        self.feed(node, Input::AppChanged(AppFact::own_registered(app, name, Vec::new())));
    }

    fn becomes_ready(&mut self, node: usize, app: usize) {
        self.stages.insert((node, app), Stage::Ready);
        self.feed(node, Input::AppChanged(AppFact::Ready { app: app_address(app) }));
    }

    /// Makes an application ready that is not, or registers it again first.
    pub(super) fn begin(&mut self) {
        let is_down = |((process, _), stage): &(&(usize, usize), &Stage)| {
            **stage != Stage::Ready && !self.ended.contains(process)
        };
        let down: Vec<(usize, usize)> = self.stages.iter().filter(is_down).map(|(app, _)| *app).collect();
        if down.is_empty() {
            return;
        }
        let (node, app) = down[self.chance.index(down.len())];
        let is_unregistered = self.stages[&(node, app)] == Stage::Unregistered;
        self.note(|| format!("{} of process {node} is started", name(self.homes[node], app)));
        if is_unregistered {
            self.register(node, app);
        }
        if !is_unregistered || self.chance.once_in(2) {
            self.becomes_ready(node, app);
        }
    }

    /// Ends a life of the application. Most of those that fail or are stopped are ready again at once.
    pub(super) fn die(&mut self, node: usize, app: usize) {
        if self.stages[&(node, app)] == Stage::Unregistered {
            return;
        }
        self.judge.dies((node, app), &self.generations(node));
        let address = app_address(app);
        let fact = match self.chance.index(6) {
            0 => AppFact::Unregistered { app: address },
            1 => AppFact::Stopped { app: address },
            _ => AppFact::Down { app: address },
        };
        self.note(|| format!("{} of process {node} ends: {fact:?}", name(self.homes[node], app)));
        let is_gone = matches!(fact, AppFact::Unregistered { .. });
        let stage = if is_gone { Stage::Unregistered } else { Stage::Unready };
        self.stages.insert((node, app), stage);
        self.feed(node, Input::AppChanged(fact));
        if !is_gone && !self.chance.once_in(3) {
            self.becomes_ready(node, app);
        }
    }

    /// Returns whether the application can arrive: one that is not ready seldom does.
    fn can_arrive(&mut self, node: usize, app: usize) -> bool {
        match self.stages[&(node, app)] {
            Stage::Unregistered => false,
            Stage::Unready => self.chance.once_in(4),
            Stage::Ready => true,
        }
    }

    /// Returns whether a node has no room for one more barrier, because living applications were at all that
    /// it keeps.
    fn is_full(&self, node: usize, key: &BarrierKey) -> bool {
        let Rendezvous { barriers, barriers_max, .. } = self.cores[node].rendezvous();
        barriers.len() >= *barriers_max
            && !barriers.contains_key(key)
            && barriers.values().all(|known| !known.visitors.is_empty())
    }

    /// Lets an application wait at a barrier that never opens.
    pub(super) fn arrive_elsewhere(&mut self, node: usize, app: usize) {
        let barrier = other(self.chance.index(OTHERS));
        let parties = vec!["9 of *".to_owned()];
        let key = BarrierKey { name: Name::try_from(barrier.clone()).unwrap(), parties: parties.clone() };
        let waits = |known: &BarrierState| known.waiting.contains_key(&app_address(app));
        if !self.can_arrive(node, app)
            || self.is_full(node, &key)
            || self.cores[node].rendezvous().barriers.get(&key).is_some_and(waits)
        {
            return;
        }
        self.note(|| format!("{} of process {node} arrives at {barrier}", name(self.homes[node], app)));
        self.judge.is_somewhere(self.arriving(node, app));
        let (kind, on_loss) = (BarrierKind::Meeting, OnPartyLoss::Wait);
        let asked = ArriveAtBarrier { barrier, parties, within_ms: FOR_EVER_MS, on_loss, kind };
        let correlation = judge::ELSEWHERE;
        self.feed(node, Input::Arrived { app: app_address(app), correlation, asked });
    }

    fn arriving(&self, node: usize, app: usize) -> judge::Arriving {
        let (home, incarnation) = (self.homes[node], Incarnation(self.incarnations[node]));
        judge::Arriving { app: (node, app), name: name(home, app), node: address(home), incarnation }
    }

    pub(super) fn arrive(&mut self, node: usize, app: usize) {
        let (barrier, home) = (self.chance.index(BARRIERS.len()), self.homes[node]);
        let is_party = match barrier {
            0 => home < 3 && app == 0,
            1 => true,
            _ => app == 1 || home < 2,
        };
        if !is_party || !self.can_arrive(node, app) || self.judge.is_waiting((node, app), barrier) {
            return;
        }
        let within_ms = match self.chance.index(30) {
            short @ 0..3 if !self.is_calm => [5, 80, 400][short],
            _ => FOR_EVER_MS,
        };
        // Only at the first barrier each party has a name of its own.
        let asks = self.chance.once_in(if barrier == 0 { 3 } else { 12 }) && !self.is_calm;
        let on_loss = if asks { OnPartyLoss::Fail } else { OnPartyLoss::Wait };
        if self.fault == Some(Fault::VisitsForgotten) {
            self.cores[node].rendezvous_mut().barriers.values_mut().for_each(|known| known.visitors.clear());
        }
        let correlation = if self.is_full(node, key(barrier)) {
            UNJUDGED
        } else {
            let within = Duration::from_millis(within_ms.into());
            self.judge.arrives(self.arriving(node, app), barrier, Asked { since: self.now, within, on_loss })
        };
        self.note(|| {
            format!(
                "{} of process {node} arrives at {}, {within_ms} ms, {on_loss:?}",
                name(home, app),
                BARRIERS[barrier].0
            )
        });
        let (within_ms, on_loss) = self.received_limits(within_ms, on_loss);
        let (text, parties) = BARRIERS[barrier];
        let parties = parties.iter().map(|party| (*party).to_owned()).collect();
        let kind = BarrierKind::Meeting;
        let asked = ArriveAtBarrier { barrier: text.to_owned(), parties, within_ms, on_loss, kind };
        self.feed(node, Input::Arrived { app: app_address(app), correlation, asked });
    }

    /// Lets an application reach a phase, or stop waiting at it.
    pub(super) fn come_up(&mut self) {
        let (node, app, phase) =
            (self.any_process(None), self.chance.index(APPS), self.chance.index(PHASES.len()));
        let home = self.homes[node];
        let is_party = if phase == 0 { home < 3 && app == 0 } else { app == 1 };
        if self.judge.waits.is_at_phase((node, phase, app)) {
            if self.chance.once_in(4) {
                self.leave_phase(node, app, phase);
            }
        } else if is_party && self.can_arrive(node, app) {
            self.reach(node, app, phase);
        }
    }

    fn reach(&mut self, node: usize, app: usize, phase: usize) {
        let (text, parties) = PHASES[phase];
        let within_ms = [5, 80, 400, FOR_EVER_MS, FOR_EVER_MS][self.chance.index(5)];
        let on_loss = if self.chance.once_in(2) { OnPartyLoss::Fail } else { OnPartyLoss::Wait };
        let (name, within) = (name(self.homes[node], app), Duration::from_millis(within_ms.into()));
        self.note(|| format!("{name} of process {node} reaches {text}, {within_ms} ms, {on_loss:?}"));
        let asked = Asked { since: self.now, within, on_loss };
        let correlation = self.judge.reaches((node, phase, app), name, asked);
        let (within_ms, on_loss) = self.received_limits(within_ms, on_loss);
        let parties = parties.iter().map(|party| (*party).to_owned()).collect();
        let kind = BarrierKind::Phase;
        let asked = ArriveAtBarrier { barrier: text.to_owned(), parties, within_ms, on_loss, kind };
        self.feed(node, Input::Arrived { app: app_address(app), correlation, asked });
    }

    fn leave_phase(&mut self, node: usize, app: usize, phase: usize) {
        let barrier = PHASES[phase].0.to_owned();
        self.note(|| format!("{} of process {node} waits at {barrier} no more", name(self.homes[node], app)));
        self.judge.waits.leaves_phase((node, phase, app));
        self.feed(node, Input::Left { app: app_address(app), barrier, correlation: None });
    }

    pub(super) fn leave(&mut self, node: usize, app: usize) {
        let barrier = self.chance.index(BARRIERS.len());
        if !self.judge.is_waiting((node, app), barrier) {
            return;
        }
        self.note(|| {
            format!("{} of process {node} leaves {}", name(self.homes[node], app), BARRIERS[barrier].0)
        });
        self.judge.gives_up((node, app), barrier, self.generation(node, barrier));
        let barrier = BARRIERS[barrier].0.to_owned();
        self.feed(node, Input::Left { app: app_address(app), barrier, correlation: None });
    }
}
