//! The rules for barriers, regardless of all events, stated without the core's own code.

use std::collections::{BTreeMap, BTreeSet};

use sinew_runtime::{
    app::Requirement,
    tid::{Incarnation, NodeAddress},
};

use super::{
    BARRIERS, BarrierAnswer, Member,
    waits::{self, Asked, Waits},
};

/// The number of a request at a barrier that is not judged.
pub(super) const ELSEWHERE: u64 = u64::MAX - 1;

/// An application, by its process and number.
type App = (usize, usize);

/// An application that arrives.
pub(super) struct Arriving {
    pub(super) app: App,
    pub(super) name: String,
    pub(super) node: NodeAddress,
    pub(super) incarnation: Incarnation,
}

/// One wait of one life of an application at one barrier.
#[derive(Debug)]
struct Visit {
    correlation: u64,
    /// The generation that it passed.
    passed: Option<u64>,
    /// Set when the application gave up or died: the openings of the barrier until then, as far as its node
    /// knew.
    over: Option<u64>,
}

/// Counts of events, so that a simulation with few events is noticed.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Seen {
    opened: [u64; BARRIERS.len()],
    timed_out: u64,
    lost: u64,
    given_up: u64,
    deaths: u64,
    calm: u64,
    waits_at_the_end: u64,
    counted: u64,
    duplicates: u64,
    pub(super) crowded_out: u64,
    pub(super) handed_again: u64,
    waits: waits::Seen,
}

impl Seen {
    pub(super) fn add(&mut self, other: &Self) {
        for (sum, of_seed) in self.opened.iter_mut().zip(other.opened) {
            *sum += of_seed;
        }
        self.timed_out += other.timed_out;
        self.lost += other.lost;
        self.given_up += other.given_up;
        self.deaths += other.deaths;
        self.calm += other.calm;
        self.waits_at_the_end += other.waits_at_the_end;
        self.counted += other.counted;
        self.duplicates += other.duplicates;
        self.crowded_out += other.crowded_out;
        self.handed_again += other.handed_again;
        self.waits.add(&other.waits);
    }

    pub(super) fn must_cover_everything(&self) {
        let ends = [self.timed_out, self.lost, self.given_up, self.deaths];
        let rest = [self.calm, self.waits_at_the_end, self.counted, self.duplicates];
        let odd = [self.crowded_out, self.handed_again];
        let counts = [ends.as_slice(), &rest, &odd].concat();
        assert!(
            counts.iter().chain(&self.opened).all(|count| *count > 10),
            "hardly anything happens: {self:?}"
        );
        self.waits.must_cover_everything();
    }
}

pub(super) struct Judge {
    /// The members of each application that has arrived somewhere in its present life. After each visit that
    /// it gave up, the application is another member. The last one is for its next visit.
    parties: BTreeMap<App, Vec<Member>>,
    /// The number of members in this incarnation of a node.
    counts: BTreeMap<usize, u64>,
    /// The application of each member.
    names: BTreeMap<Member, String>,
    visits: BTreeMap<(usize, Member), Vec<Visit>>,
    /// The members of each generation of a barrier, for each node that opened it from its own observation.
    openings: BTreeMap<(usize, u64), Vec<BTreeSet<Member>>>,
    correlation: u64,
    /// The nodes that had a duplicate: state received from one of the two may be forgotten in favour of the
    /// other.
    duplicated: BTreeSet<NodeAddress>,
    /// No application dies or gives up, and no node is lost.
    is_calm: bool,
    pub(super) waits: Waits,
    pub(super) violations: Vec<String>,
    pub(super) seen: Seen,
}

/// Returns the next number of a process.
fn next(counts: &mut BTreeMap<usize, u64>, process: usize) -> u64 {
    let count = counts.entry(process).or_default();
    *count += 1;
    *count
}

fn is_met(barrier: usize, names: &[String]) -> bool {
    BARRIERS[barrier].1.iter().all(|text| {
        let party: Requirement = text.parse().unwrap();
        names.iter().filter(|name| party.counts(name)).count() >= party.count()
    })
}

impl Judge {
    pub(super) fn new(is_calm: bool, is_crowded: bool) -> Self {
        Self {
            parties: BTreeMap::new(),
            counts: BTreeMap::new(),
            names: BTreeMap::new(),
            visits: BTreeMap::new(),
            openings: BTreeMap::new(),
            correlation: 0,
            duplicated: BTreeSet::new(),
            is_calm,
            waits: Waits::new(is_crowded),
            violations: Vec::new(),
            seen: Seen::default(),
        }
    }

    /// Returns the violations and the counted events.
    pub(super) fn verdict(self) -> (Vec<String>, Seen) {
        let Self { waits, mut violations, mut seen, .. } = self;
        violations.extend(waits.violations);
        seen.waits = waits.seen;
        (violations, seen)
    }

    fn open_visit(&mut self, app: App, barrier: usize) -> Option<&mut Visit> {
        let visits = &self.visits;
        let waits = |member: &&Member| {
            let last = visits.get(&(barrier, **member)).and_then(|visits| visits.last());
            last.is_some_and(|last| last.passed.is_none() && last.over.is_none())
        };
        let member = *self.parties.get(&app)?.iter().find(waits)?;
        self.visits.get_mut(&(barrier, member))?.last_mut()
    }

    pub(super) fn is_waiting(&mut self, app: App, barrier: usize) -> bool {
        self.open_visit(app, barrier).is_some()
    }

    /// Records the arrival of an application. Returns the number of its request.
    pub(super) fn arrives(&mut self, who: Arriving, barrier: usize, asked: Asked) -> u64 {
        self.correlation += 1;
        let (process, app) = who.app;
        self.waits.arrives((process, barrier, app), who.name.clone(), asked);
        let member = self.is_somewhere(who);
        let visit = Visit { correlation: self.correlation, passed: None, over: None };
        self.visits.entry((barrier, member)).or_default().push(visit);
        self.correlation
    }

    /// Records that an application has reached a phase and waits there for others. Returns the number of its
    /// request.
    pub(super) fn reaches(
        &mut self,
        (process, phase, app): (usize, usize, usize),
        name: String,
        asked: Asked,
    ) -> u64 {
        self.correlation += 1;
        self.waits.reaches((process, phase, app), name, (self.correlation, asked));
        self.correlation
    }

    /// Records an application at some barrier. Returns its member.
    pub(super) fn is_somewhere(&mut self, Arriving { app, name, node, incarnation }: Arriving) -> Member {
        let counts = &mut self.counts;
        let members = self.parties.entry(app).or_insert_with(|| {
            let party = next(counts, app.0);
            vec![Member { node, incarnation, party }]
        });
        let member = members[members.len() - 1];
        self.names.insert(member, name);
        member
    }

    /// Records that two processes have this address.
    pub(super) fn add_duplicate(&mut self, node: NodeAddress) {
        self.seen.duplicates += 1;
        self.duplicated.insert(node);
    }

    pub(super) fn gives_up(&mut self, app: App, barrier: usize, generation: u64) {
        self.seen.given_up += 1;
        self.waits.leaves((app.0, barrier, app.1));
        let Some(visit) = self.open_visit(app, barrier) else { return };
        visit.over = Some(generation);
        // Reports about this visit do not concern the next one.
        if let Some(members) = self.parties.get_mut(&app) {
            let party = next(&mut self.counts, app.0);
            members.push(Member { party, ..members[0] });
        }
    }

    pub(super) fn dies(&mut self, app: App, generations: &[u64]) {
        self.seen.deaths += 1;
        self.waits.forgets_phases(app);
        for (barrier, generation) in generations.iter().enumerate() {
            self.waits.leaves((app.0, barrier, app.1));
            if let Some(visit) = self.open_visit(app, barrier) {
                visit.over = Some(*generation);
            }
        }
        self.parties.remove(&app);
    }

    pub(super) fn restarts(&mut self, node: usize) {
        self.counts.remove(&node);
        self.waits.restarts(node);
    }

    pub(super) fn answered(
        &mut self,
        app: App,
        correlation: u64,
        answer: &BarrierAnswer,
        generations: &[u64],
    ) {
        if self.waits.answered_at_phase(app, correlation, answer) {
            return;
        }
        let asked = (0..BARRIERS.len()).find(|barrier| {
            self.open_visit(app, *barrier).is_some_and(|visit| visit.correlation == correlation)
        });
        let Some(barrier) = asked else {
            return self.violations.push(format!("{app:?} is answered what it does not ask: {answer:?}"));
        };
        match answer {
            BarrierAnswer::Opened { generation } => self.passes(app, barrier, *generation),
            BarrierAnswer::TimedOut { .. } | BarrierAnswer::Lost { .. } => {
                self.waits.ends((app.0, barrier, app.1), answer);
                let is_lost = matches!(answer, BarrierAnswer::Lost { .. });
                *(if is_lost { &mut self.seen.lost } else { &mut self.seen.timed_out }) += 1;
                self.gives_up(app, barrier, generations[barrier]);
            }
            BarrierAnswer::Refused { why } => self.violations.push(format!("{app:?} is refused: {why}")),
        }
    }

    fn passes(&mut self, app: App, barrier: usize, generation: u64) {
        self.seen.opened[barrier] += 1;
        self.waits.passes((app.0, barrier, app.1), generation);
        let of_it = self.parties[&app].iter().filter_map(|member| self.visits.get(&(barrier, *member)));
        let before = of_it.flatten().filter_map(|visit| visit.passed).max();
        if before.is_some_and(|before| before >= generation) {
            self.violations.push(format!("{app:?} passes generation {generation} after {before:?}"));
        }
        self.open_visit(app, barrier).unwrap().passed = Some(generation);
    }

    /// Checks a generation that a node reports as opened by these members.
    pub(super) fn opened(&mut self, barrier: usize, generation: u64, members: &BTreeSet<Member>) {
        if generation == 0 {
            return;
        }
        for member in members {
            // A counted member was present, and had not passed before.
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

    /// Records that a node has opened this generation without a report from others.
    pub(super) fn opened_independently(
        &mut self,
        barrier: usize,
        generation: u64,
        members: BTreeSet<Member>,
    ) {
        self.openings.entry((barrier, generation)).or_default().push(members);
    }

    /// Checks that each counted member of a generation passed it, or no longer waits. Several nodes may open
    /// a generation independently, if more applications are possible parties than needed. Then only members
    /// seen by all of these nodes are checked: the others may have passed the next generation meanwhile. A
    /// generation known only to dead nodes has not opened.
    fn check_counted_members(&mut self, generations: &[Vec<u64>]) {
        let last = |barrier: usize| generations[barrier].iter().copied().max().unwrap_or_default();
        for ((barrier, generation), openings) in &self.openings {
            if *generation > last(*barrier) {
                continue;
            }
            let is_judged = |member: &&Member| {
                !self.duplicated.contains(&member.node) && openings.iter().all(|by| by.contains(*member))
            };
            let seen_by_all = openings[0].iter().filter(is_judged);
            for member in seen_by_all {
                let visits = self.visits.get(&(*barrier, *member)).into_iter().flatten();
                let mut ways = visits.map(|visit| (visit.passed, visit.over));
                let is_well = ways.any(|(passed, over)| {
                    passed == Some(*generation) || over.is_some_and(|over| *generation <= over + 1)
                });
                self.seen.counted += 1;
                if !is_well {
                    let (barrier, who) = (BARRIERS[*barrier].0, &self.names[member]);
                    self.violations
                        .push(format!("{who} counted for {barrier} {generation} and has not passed it"));
                }
            }
        }
    }

    /// Checks the state after quiet: every link is up and everything was delivered.
    pub(super) fn all_is_quiet(&mut self, generations: &[Vec<u64>]) {
        for (barrier, of_barrier) in generations.iter().enumerate() {
            self.after_quiet(barrier, of_barrier);
        }
        self.check_counted_members(generations);
        self.waits.all_is_quiet_at_phases();
    }

    fn after_quiet(&mut self, barrier: usize, generations: &[u64]) {
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
        // If no application died or gave up, named parties pass every generation together.
        if barrier == 0 && self.is_calm && !generations.is_empty() {
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
