//! The rules for each wait at a phase. It ends when its parties have reached the phase by the last reports of
//! their nodes, at its deadline, or by a loss. Meanwhile the missing parties and the reasons are reported.

use super::*;

/// The maximum number of applications named for an unmet count.
const NAMED_MAX: usize = 8;

/// An application that has reached a phase, and waits there for others.
struct AtPhase {
    wait: Wait,
    /// The correlation of its request.
    correlation: u64,
    parties: Vec<Party>,
}

/// A party, as seen by a waiting application: since when it is missing, and since when it has ended, at the
/// earliest and for certain.
#[derive(Clone, Copy, Default)]
struct Party {
    absent: Option<Time>,
    perhaps_lost: Option<Time>,
    surely_lost: Option<Time>,
}

/// An application that has not reached a phase.
#[derive(Debug)]
struct Lacking {
    party: usize,
    /// The reported name.
    what: String,
    /// One of these is right.
    why: Vec<Reason>,
}

pub(super) struct Phases {
    /// The parties of each phase.
    parties: Vec<Vec<Requirement>>,
    open: BTreeMap<Place, AtPhase>,
    /// Processes and phases with a wait that has ended at this moment.
    over: BTreeSet<(usize, usize)>,
    /// The name of each application that has really reached a phase in its present life.
    reached: BTreeMap<Place, String>,
    /// The names of those that have ever reached a phase.
    ever: BTreeSet<(usize, String)>,
}

impl Phases {
    pub(super) fn new() -> Self {
        let parties = PHASES.iter().map(|(phase, texts)| {
            let party = |text: &&str| text.parse::<Requirement>().unwrap().at(*phase);
            texts.iter().map(party).collect::<Vec<_>>()
        });
        Self {
            parties: parties.collect(),
            open: BTreeMap::new(),
            over: BTreeSet::new(),
            reached: BTreeMap::new(),
            ever: BTreeSet::new(),
        }
    }

    /// Returns the names that a process waits for, or has waited for until this moment.
    pub(super) fn awaited(&self, process: usize) -> impl Iterator<Item = &str> {
        let open = self.open.keys().map(|(of, phase, _)| (*of, *phase));
        let places = open.chain(self.over.iter().copied()).filter(move |(of, _)| *of == process);
        let parties = places.flat_map(move |(_, phase)| &self.parties[phase]);
        parties.flat_map(Requirement::alternatives).map(String::as_str)
    }

    pub(super) fn next_moment(&mut self) {
        self.over.clear();
    }

    fn waits(&self, process: usize, phase: usize) -> impl Iterator<Item = &AtPhase> {
        self.open.range((process, phase, 0)..(process, phase + 1, 0)).map(|(_, at)| at)
    }

    /// Returns the time at which each wait of a process must be over.
    pub(super) fn due_of(&self, process: usize) -> impl Iterator<Item = Time> {
        self.open.range((process, 0, 0)..(process + 1, 0, 0)).map(|(_, at)| at.due())
    }

    /// Returns whether all parties of a phase are among these.
    fn are_all(&self, phase: usize, names: &BTreeSet<&str>) -> bool {
        let is_there =
            |party: &Requirement| names.iter().filter(|name| party.counts(name)).count() >= party.count();
        self.parties[phase].iter().all(is_there)
    }
}

impl AtPhase {
    /// Returns the time at which the wait must be over.
    fn due(&self) -> Time {
        let Wait { until, on_loss, .. } = self.wait;
        let lost = self.parties.iter().filter_map(|party| party.surely_lost).min();
        let lost = lost.filter(|_| on_loss == OnPartyLoss::Fail);
        lost.map_or(until, |lost| until.min(lost + GRACE))
    }

    /// Returns why the wait may not be ended because of a loss now.
    fn why_not_lost(&self, now: Time) -> Option<String> {
        if self.wait.on_loss == OnPartyLoss::Wait {
            return Some("wants to wait for the party's return".to_owned());
        }
        match self.parties.iter().filter_map(|party| party.perhaps_lost).min() {
            None => Some("no party is lost".to_owned()),
            Some(since) if now < since + GRACE => Some(format!("the party is lost since {since:?}")),
            Some(_) => None,
        }
    }
}

impl Party {
    /// Updates the times of a party. A count is never lost. // spec: SYNC-13
    fn update(&mut self, now: Time, party: &Requirement, lacking: &[&Lacking]) {
        let is_named = party.one_name().is_some();
        let ends = |lacking: &&Lacking| is_named && lacking.why.iter().any(|why| is_end(Some(*why)));
        let must_end = |lacking: &&Lacking| is_named && lacking.why.iter().all(|why| is_end(Some(*why)));
        let since = |known: Option<Time>, is_so: bool| is_so.then(|| known.unwrap_or(now));
        self.absent = since(self.absent, !lacking.is_empty());
        self.perhaps_lost = since(self.perhaps_lost, lacking.iter().any(ends));
        self.surely_lost = since(self.surely_lost, lacking.iter().any(must_end));
    }
}

/// Returns the reasons in the form in which they are compared with the reports.
fn comparable(lacking: &[Lacking]) -> Vec<(String, Vec<(String, &'static str)>)> {
    let words = |why: &Reason| (why.words().to_owned(), why.words());
    lacking.iter().map(|lacking| (lacking.what.clone(), lacking.why.iter().map(words).collect())).collect()
}

impl Waits {
    /// Records that an application has reached a phase, and waits there for others by the request of this
    /// correlation.
    pub(in crate::barriers) fn reaches(
        &mut self,
        place: Place,
        name: String,
        (correlation, asked): (u64, Asked),
    ) {
        let Asked { since, within, on_loss } = asked;
        let phases = &mut self.phases;
        phases.ever.insert((place.1, name.clone()));
        phases.reached.insert(place, name.clone());
        let parties = vec![Party::default(); phases.parties[place.1].len()];
        let wait = Wait { name, since, until: since + within, on_loss };
        phases.open.insert(place, AtPhase { wait, correlation, parties });
    }

    pub(in crate::barriers) fn is_at_phase(&self, place: Place) -> bool {
        self.phases.open.contains_key(&place)
    }

    /// Records that the application no longer waits; it has still reached the phase.
    pub(in crate::barriers) fn leaves_phase(&mut self, place: Place) {
        self.phases.open.remove(&place);
    }

    /// Records the end of an application's life: the next life has reached nothing.
    pub(in crate::barriers) fn forgets_phases(&mut self, app: (usize, usize)) {
        let is_other = |(process, _, other): &Place| (*process, *other) != app;
        self.phases.open.retain(|place, _| is_other(place));
        self.phases.reached.retain(|place, _| is_other(place));
    }

    /// Handles an answer to an application that waits at a phase. Returns whether it is one.
    pub(in crate::barriers) fn answered_at_phase(
        &mut self,
        (process, app): (usize, usize),
        correlation: u64,
        answer: &BarrierAnswer,
    ) -> bool {
        let is_asked = |((of, _, other), at): &(&Place, &AtPhase)| {
            (*of, *other, at.correlation) == (process, app, correlation)
        };
        let Some(place) = self.phases.open.iter().find(is_asked).map(|(place, _)| *place) else {
            return false;
        };
        self.update_phases(process);
        let at = self.phases.open.remove(&place).expect("it was found");
        self.phases.over.insert((process, place.1));
        let (now, who) = (self.now, format!("{} of process {process}", at.wait.name));
        let why_not = match answer {
            BarrierAnswer::Opened { generation } => self.why_not_open((process, place.1), *generation),
            BarrierAnswer::TimedOut { missing } => {
                let until = at.wait.until;
                let is_early = (now < until).then(|| format!("has time until {until:?}"));
                is_early.or_else(|| self.ends_at_phase((process, place.1), &at, missing))
            }
            BarrierAnswer::Lost { missing } => {
                at.why_not_lost(now).or_else(|| self.ends_at_phase((process, place.1), &at, missing))
            }
            BarrierAnswer::Refused { .. } => Some("asks for what it may".to_owned()),
        };
        let way = match answer {
            BarrierAnswer::Opened { .. } => Some(0),
            BarrierAnswer::TimedOut { .. } => Some(1),
            BarrierAnswer::Lost { .. } => Some(2),
            BarrierAnswer::Refused { .. } => None,
        };
        way.into_iter().for_each(|way: usize| self.seen.at_phases[way] += 1);
        self.violations.extend(
            why_not.map(|why_not| format!("at {now:?} {who} receives {answer:?} at a phase, but {why_not}")),
        );
        true
    }

    /// Returns why a phase may not open now.
    fn why_not_open(&self, (process, phase): (usize, usize), generation: u64) -> Option<String> {
        let lacking = self.lacking((process, phase));
        let of_it = self.phases.ever.iter().filter(|(other, _)| *other == phase);
        let ever: BTreeSet<&str> = of_it.map(|(_, name)| &**name).collect();
        if !lacking.is_empty() {
            Some(format!("lacks {lacking:?}"))
        } else if !self.phases.are_all(phase, &ever) {
            Some(format!("only {ever:?} have ever reached it"))
        } else {
            (generation != 1).then(|| "a life reaches a phase once".to_owned())
        }
    }

    /// Records the end of a wait without an opening. Returns why it is not in time.
    fn ends_at_phase(
        &mut self,
        (process, phase): (usize, usize),
        at: &AtPhase,
        missing: &[(String, String)],
    ) -> Option<String> {
        let right = comparable(&self.lacking((process, phase)));
        let missing = missing.iter().map(|(name, why)| (&**name, &**why));
        self.check_reasons((process, PHASES[phase].0), right, missing);
        self.why_untimely(process, at.due())
    }

    /// Returns the applications that have not reached a phase, by the inputs of a process.
    fn lacking(&self, (process, phase): (usize, usize)) -> Vec<Lacking> {
        let inputs = &self.inputs[&process];
        let why = |name: &str| -> Vec<Reason> {
            inputs.reasons(name, Some(PHASES[phase].0)).into_iter().flatten().collect()
        };
        let mut lacking = Vec::new();
        for (at, party) in self.phases.parties[phase].iter().enumerate() {
            let mut lacks = |what: String, why: Vec<Reason>| lacking.push(Lacking { party: at, what, why });
            if let Some(name) = party.one_name() {
                let why = why(name);
                if !why.is_empty() {
                    lacks(party.to_string(), why);
                }
                continue;
            }
            let names: BTreeSet<&str> = inputs.names().filter(|name| party.counts(name)).collect();
            let reasons = names.into_iter().map(|name| (name, why(name)));
            let (there, others): (Vec<_>, Vec<_>) = reasons.partition(|(_, why)| why.is_empty());
            if there.len() >= party.count() {
                continue;
            }
            let what = format!("{party} ({} there)", there.len());
            if others.is_empty() {
                lacks(what, vec![Reason::NotThere]);
                continue;
            }
            for (name, why) in others.into_iter().take(NAMED_MAX) {
                lacks(format!("{what}: {name}"), why);
            }
        }
        lacking
    }

    /// Updates since when each party is missing, and lost.
    pub(super) fn update_phases(&mut self, process: usize) {
        let now = self.now;
        for phase in 0..PHASES.len() {
            if self.phases.waits(process, phase).next().is_none() {
                continue;
            }
            let lacking = self.lacking((process, phase));
            for (_, at) in self.phases.open.range_mut((process, phase, 0)..(process, phase + 1, 0)) {
                let parties = self.phases.parties[phase].iter();
                for (number, (party, known)) in parties.zip(&mut at.parties).enumerate() {
                    let of_it: Vec<&Lacking> =
                        lacking.iter().filter(|lacking| lacking.party == number).collect();
                    known.update(now, party, &of_it);
                }
            }
        }
    }

    /// Checks the states of its phases that a process reports.
    pub(super) fn check_phases(&mut self, process: usize, statuses: &[BarrierStatus]) {
        for (phase, (name, _)) in PHASES.into_iter().enumerate() {
            let is_it = |status: &&BarrierStatus| status.kind == BarrierKind::Phase && status.barrier == name;
            let status = statuses.iter().find(is_it);
            let reported: Vec<_> =
                status.into_iter().flat_map(|status| status.waiting.iter().cloned()).collect();
            let waits = self.phases.waits(process, phase).map(|at| &at.wait);
            let right: Vec<_> = waits.map(|wait| (wait.name.clone(), self.now.since(wait.since))).collect();
            if reported != right {
                self.violations
                    .push(format!("process {process} says that at {name} wait {reported:?}, not {right:?}"));
            }
            if !right.is_empty() && self.lacking((process, phase)).is_empty() {
                self.violations
                    .push(format!("{right:?} of process {process} wait at {name}, which lacks no party"));
            }
            status.into_iter().for_each(|status| self.check_lacking((process, phase), status));
        }
        self.check_deadlines_at_phases(process);
    }

    fn check_lacking(&mut self, (process, phase): (usize, usize), status: &BarrierStatus) {
        let lacking = self.lacking((process, phase));
        let missing = status.missing.iter().map(|Absence { name, why, .. }| (&**name, &**why));
        self.check_reasons((process, PHASES[phase].0), comparable(&lacking), missing);
        for (Lacking { party, what, .. }, absence) in lacking.iter().zip(&status.missing) {
            // Of several waits, the first has the longest absence.
            let absent = self.phases.waits(process, phase).filter_map(|at| at.parties[*party].absent).min();
            let (reported, right) = (absence.since, absent.map(|absent| self.now.since(absent)));
            if right != Some(reported) {
                self.violations.push(format!(
                    "{what} is reported to be missing for {reported:?}, and has been for {right:?}"
                ));
            }
        }
    }

    /// Checks that no wait at a phase continues beyond its due time.
    fn check_deadlines_at_phases(&mut self, process: usize) {
        let now = self.now;
        if self.grace_periods.get(&process).is_some_and(|grace_period| now < grace_period.most) {
            return;
        }
        for ((_, phase, _), at) in self.phases.open.range((process, 0, 0)..(process + 1, 0, 0)) {
            let (who, phase, due) = (&at.wait.name, PHASES[*phase].0, at.due());
            if due <= now {
                self.violations.push(format!(
                    "at {now:?} {who} of process {process} still waits at {phase}, which was over at {due:?}"
                ));
            }
        }
    }

    /// Checks after quiet, with every link up and everything delivered, that no application waits where all
    /// have reached the phase.
    pub(in crate::barriers) fn all_is_quiet_at_phases(&mut self) {
        for ((process, phase, _), at) in &self.phases.open {
            let of_it = self.phases.reached.iter().filter(|((_, other, _), _)| other == phase);
            let reached: BTreeSet<&str> = of_it.map(|(_, name)| &**name).collect();
            if self.phases.are_all(*phase, &reached) {
                let (who, phase) = (&at.wait.name, PHASES[*phase].0);
                self.violations.push(format!(
                    "{who} of process {process} still waits at {phase}, which all of {reached:?} have reached"
                ));
            }
        }
    }
}
