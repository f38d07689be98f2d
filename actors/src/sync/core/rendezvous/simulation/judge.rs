//! What must hold at barriers, whatever happens, said without the core's means.

use std::collections::{BTreeMap, BTreeSet};

use sinew_runtime::{
    app::Requirement,
    tid::{Incarnation, NodeAddress},
};

use super::{BARRIERS, BarrierAnswer, Member, name};

/// An application, by its node and number.
type App = (usize, usize);

/// One wait of one life at one barrier.
#[derive(Debug)]
struct Visit {
    correlation: u64,
    /// The generation that it passed.
    passed: Option<u64>,
    /// It gave up or died; how often the barrier had opened then, as far as its node knew.
    over: Option<u64>,
}

/// What happened at all, so that a quiet simulation is noticed.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Seen {
    opened: [u64; BARRIERS.len()],
    timed_out: u64,
    lost: u64,
    given_up: u64,
    deaths: u64,
    calm: u64,
    waits_at_the_end: u64,
}

impl Seen {
    pub(super) fn add(&mut self, other: Self) {
        for (sum, of_seed) in self.opened.iter_mut().zip(other.opened) {
            *sum += of_seed;
        }
        self.timed_out += other.timed_out;
        self.lost += other.lost;
        self.given_up += other.given_up;
        self.deaths += other.deaths;
        self.calm += other.calm;
        self.waits_at_the_end += other.waits_at_the_end;
    }

    pub(super) fn must_cover_everything(self) {
        let counts =
            [self.timed_out, self.lost, self.given_up, self.deaths, self.calm, self.waits_at_the_end];
        assert!(
            counts.iter().chain(&self.opened).all(|count| *count > 10),
            "hardly anything happens: {self:?}"
        );
    }
}

#[derive(Default)]
pub(super) struct Judge {
    /// The present life of each application that has arrived somewhere, and who it is.
    parties: BTreeMap<App, Member>,
    /// Lives that have arrived somewhere in this life of a node.
    counts: BTreeMap<usize, u64>,
    /// Which application a life is one of.
    names: BTreeMap<Member, String>,
    visits: BTreeMap<(usize, Member), Vec<Visit>>,
    correlation: u64,
    /// Nobody dies, gives up or is taken for lost.
    is_calm: bool,
    pub(super) violations: Vec<String>,
    pub(super) seen: Seen,
}

fn is_met(barrier: usize, names: &[String]) -> bool {
    BARRIERS[barrier].1.iter().all(|text| {
        let party: Requirement = text.parse().unwrap();
        names.iter().filter(|name| party.counts(name)).count() >= party.count()
    })
}

impl Judge {
    pub(super) fn new(is_calm: bool) -> Self {
        Self { is_calm, ..Self::default() }
    }

    fn open_visit(&mut self, app: App, barrier: usize) -> Option<&mut Visit> {
        let member = self.parties.get(&app)?;
        let last = self.visits.get_mut(&(barrier, *member))?.last_mut()?;
        (last.passed.is_none() && last.over.is_none()).then_some(last)
    }

    pub(super) fn waits(&mut self, app: App, barrier: usize) -> bool {
        self.open_visit(app, barrier).is_some()
    }

    /// An application arrives; the number of its request is returned.
    pub(super) fn arrives(
        &mut self,
        app: App,
        barrier: usize,
        incarnation: Incarnation,
        node: NodeAddress,
    ) -> u64 {
        self.correlation += 1;
        let counts = &mut self.counts;
        let member = *self.parties.entry(app).or_insert_with(|| {
            let count = counts.entry(app.0).or_default();
            *count += 1;
            Member { node, incarnation, party: *count }
        });
        self.names.insert(member, name(app.0, app.1));
        let visit = Visit { correlation: self.correlation, passed: None, over: None };
        self.visits.entry((barrier, member)).or_default().push(visit);
        self.correlation
    }

    pub(super) fn gives_up(&mut self, app: App, barrier: usize, generation: u64) {
        self.seen.given_up += 1;
        if let Some(visit) = self.open_visit(app, barrier) {
            visit.over = Some(generation);
        }
    }

    pub(super) fn dies(&mut self, app: App, generations: &[u64]) {
        self.seen.deaths += 1;
        for (barrier, generation) in generations.iter().enumerate() {
            if let Some(visit) = self.open_visit(app, barrier) {
                visit.over = Some(*generation);
            }
        }
        self.parties.remove(&app);
    }

    pub(super) fn restarts(&mut self, node: usize) {
        self.counts.remove(&node);
    }

    pub(super) fn answered(
        &mut self,
        app: App,
        correlation: u64,
        answer: &BarrierAnswer,
        generations: &[u64],
    ) {
        let asked = (0..BARRIERS.len()).find(|barrier| {
            self.open_visit(app, *barrier).is_some_and(|visit| visit.correlation == correlation)
        });
        let Some(barrier) = asked else {
            return self.violations.push(format!("{app:?} is answered what it does not ask: {answer:?}"));
        };
        match answer {
            BarrierAnswer::Opened { generation } => self.passes(app, barrier, *generation),
            BarrierAnswer::TimedOut { missing } | BarrierAnswer::Lost { missing } => {
                if missing.is_empty() {
                    self.violations.push(format!("{app:?} is not told who is missing"));
                }
                let is_lost = matches!(answer, BarrierAnswer::Lost { .. });
                *(if is_lost { &mut self.seen.lost } else { &mut self.seen.timed_out }) += 1;
                self.gives_up(app, barrier, generations[barrier]);
            }
            BarrierAnswer::Refused { why } => self.violations.push(format!("{app:?} is refused: {why}")),
        }
    }

    fn passes(&mut self, app: App, barrier: usize, generation: u64) {
        self.seen.opened[barrier] += 1;
        let member = self.parties[&app];
        let visits = self.visits.get_mut(&(barrier, member)).unwrap();
        let before = visits.iter().filter_map(|visit| visit.passed).max();
        if before.is_some_and(|before| before >= generation) {
            self.violations.push(format!("{app:?} passes generation {generation} after {before:?}"));
        }
        visits.last_mut().unwrap().passed = Some(generation);
    }

    /// A node says that this generation was opened by these.
    pub(super) fn opened(&mut self, barrier: usize, generation: u64, members: &BTreeSet<Member>) {
        if generation == 0 {
            return;
        }
        for member in members {
            // Whoever counts was there, and had not gone on before.
            let visits = self.visits.get(&(barrier, *member));
            let has_waited = visits.into_iter().flatten().any(|visit| match (visit.passed, visit.over) {
                (Some(passed), _) => passed >= generation,
                (None, Some(over)) => generation <= over + 1,
                (None, None) => true,
            });
            if !has_waited {
                let violation =
                    format!("{} {generation} is opened early: {member:?} was not there", BARRIERS[barrier].0);
                self.violations.push(violation);
            }
        }
        let names: Vec<String> =
            members.iter().filter_map(|member| self.names.get(member)).cloned().collect();
        if !is_met(barrier, &names) {
            self.violations
                .push(format!("{} {generation} is opened early, by {names:?}", BARRIERS[barrier].0));
        }
    }

    /// Every link is up and everything was heard.
    pub(super) fn after_quiet(&mut self, barrier: usize, generations: &[u64]) {
        let is_waiting =
            |visits: &Vec<Visit>| visits.iter().any(|visit| visit.passed.is_none() && visit.over.is_none());
        let of_barrier = self.visits.iter().filter(|((other, _), _)| *other == barrier);
        let waiting: Vec<String> = of_barrier
            .clone()
            .filter(|(_, visits)| is_waiting(visits))
            .map(|((_, member), _)| self.names[member].clone())
            .collect();
        self.seen.waits_at_the_end += waiting.len() as u64;
        if is_met(barrier, &waiting) {
            self.violations
                .push(format!("all wait at {} and it does not open: {waiting:?}", BARRIERS[barrier].0));
        }
        if generations.iter().any(|generation| *generation != generations[0]) {
            let names = BARRIERS[barrier].0;
            self.violations.push(format!("after quiet {names} has generations {generations:?}"));
        }
        // Where nobody died or gave up, named parties go through every generation together.
        if barrier == 0 && self.is_calm {
            self.seen.calm += 1;
            let passed: BTreeSet<Vec<u64>> = of_barrier
                .map(|(_, visits)| visits.iter().filter_map(|visit| visit.passed).collect())
                .collect();
            if passed.len() > 1 && generations[0] > 0 {
                self.violations.push(format!("not all went through all generations: {passed:?}"));
            }
        }
    }
}
