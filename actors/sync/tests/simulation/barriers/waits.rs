//! The rules for each wait: when it ends, which applications are notified of a loss, and the reported missing
//! parties and reasons. The judge uses the inputs and the reports of each process.

mod mutual;
mod phases;

use sinew_model::barrier::BarrierStatus;
use sinew_runtime::app::Requirement;

use self::phases::Phases;
use super::{inputs::ProcessInputs, *};

/// Time from a loss until an application that does not wait for the party's return is notified.
/// spec: SYNC-13
const GRACE: Duration = Duration::from_millis(50);
/// A process that was late by more has a grace period before it reports that a wait is over. // spec: SYNC-16
const LATE: Duration = Duration::from_millis(10);
/// The longest grace period. // spec: SYNC-16
pub(super) const GRACE_PERIOD_MAX: Duration = Duration::from_millis(50);
/// The reason reported for a party that could arrive.
const READY: &str = "ready, has not arrived";
/// The reason kind of a party without a name of its own: how many of its count have arrived.
const COUNTED: &str = "so many of so many have arrived";
/// The reason kind of a party that waits elsewhere for an application that waits for it.
const MUTUAL: &str = "waits elsewhere for one who waits here";
/// Each reason that can be reported here.
const REASONS: [&str; 14] = [
    Reason::NotReached.words(),
    Reason::NotReady.words(),
    Reason::Failed.words(),
    Reason::Stopped.words(),
    Reason::ListAwaited.words(),
    Reason::NodeRestarted.words(),
    Reason::LinkDown.words(),
    Reason::NodeLeft.words(),
    Reason::NodeLost.words(),
    Reason::Unregistered.words(),
    Reason::NotThere.words(),
    READY,
    COUNTED,
    MUTUAL,
];

/// Returns whether this ends the known state of an application. // spec: SYNC-13
fn is_end(why: Option<Reason>) -> bool {
    let ends = [Reason::Failed, Reason::Stopped, Reason::Unregistered];
    let of_its_node = [Reason::NodeLeft, Reason::NodeLost, Reason::NodeRestarted];
    why.is_some_and(|why| ends.contains(&why) || of_its_node.contains(&why))
}

/// The request of an arriving application.
#[derive(Clone, Copy, Debug)]
pub(super) struct Asked {
    pub(super) since: Time,
    pub(super) within: Duration,
    pub(super) on_loss: OnPartyLoss,
}

/// A process, a barrier, and one of the applications of the process.
type Place = (usize, usize, usize);

/// A waiting application.
struct Wait {
    name: String,
    since: Time,
    until: Time,
    on_loss: OnPartyLoss,
}

/// A party that has ended and is missing, without a report of an opening: since when at the earliest, and
/// since when for certain.
struct Lost {
    /// The number of openings of the barrier.
    generation: u64,
    perhaps: Time,
    surely: Option<Time>,
}

/// Time that a process has to read before it reports that a wait is over.
struct GracePeriod {
    /// It reports no earlier.
    least: Time,
    /// It may delay the report no longer.
    most: Time,
}

/// How often each reason was found to be right, so that a simulation which tries few is noticed. Also the
/// number of grace periods, and of waits at phases by their end: an opening, a deadline, a loss.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub(super) struct Seen {
    reasons: BTreeMap<&'static str, u64>,
    put_off: u64,
    at_phases: [u64; 3],
}

impl Seen {
    pub(super) fn add(&mut self, other: &Self) {
        for (reason, times) in &other.reasons {
            *self.reasons.entry(reason).or_default() += times;
        }
        self.put_off += other.put_off;
        for (sum, of_seed) in self.at_phases.iter_mut().zip(other.at_phases) {
            *sum += of_seed;
        }
    }

    pub(super) fn must_cover_everything(&self) {
        let is_tried = |reason: &&str| self.reasons.get(reason).is_some_and(|times| *times > 10);
        assert!(REASONS.iter().all(is_tried), "hardly any reason is reported: {self:?}");
        assert!(self.put_off > 10, "hardly anybody stood still when something was due: {self:?}");
        assert!(
            self.at_phases.iter().all(|times| *times > 10),
            "hardly anybody comes up in phases: {self:?}"
        );
    }
}

pub(super) struct Waits {
    /// The parties of each barrier, in the order of their texts.
    parties: Vec<Vec<Requirement>>,
    inputs: BTreeMap<usize, ProcessInputs>,
    now: Time,
    open: BTreeMap<Place, Wait>,
    /// Waits that were still open at the last check of presence, and have got another answer than an opening.
    over: BTreeMap<Place, Wait>,
    /// Waits that have passed at this moment.
    passed: BTreeSet<Place>,
    /// Named parties that have ended and are missing, by process and barrier.
    lost: BTreeMap<(usize, usize, String), Lost>,
    /// Parties that are missing while an application waits, by process and barrier: the number of openings,
    /// and since when.
    absent: BTreeMap<(usize, usize, String), (u64, Time)>,
    grace_periods: BTreeMap<usize, GracePeriod>,
    phases: Phases,
    /// Processes may have forgotten a barrier.
    is_crowded: bool,
    pub(super) violations: Vec<String>,
    pub(super) seen: Seen,
}

impl Waits {
    pub(super) fn new(is_crowded: bool) -> Self {
        let parties = BARRIERS.iter().map(|(_, texts)| {
            let mut parties: Vec<Requirement> = texts.iter().map(|text| text.parse().unwrap()).collect();
            parties.sort_by(|a, b| a.as_str().cmp(b.as_str()));
            parties
        });
        Self {
            parties: parties.collect(),
            inputs: BTreeMap::new(),
            now: Time::ZERO,
            open: BTreeMap::new(),
            over: BTreeMap::new(),
            passed: BTreeSet::new(),
            lost: BTreeMap::new(),
            absent: BTreeMap::new(),
            grace_periods: BTreeMap::new(),
            phases: Phases::new(),
            is_crowded,
            violations: Vec::new(),
            seen: Seen::default(),
        }
    }

    pub(super) fn arrives(&mut self, place: Place, name: String, asked: Asked) {
        let Asked { since, within, on_loss } = asked;
        self.open.insert(place, Wait { name, since, until: since + within, on_loss });
    }

    /// Records that the application gives up or dies.
    pub(super) fn leaves(&mut self, place: Place) {
        self.open.remove(&place);
    }

    pub(super) fn passes(&mut self, place: Place, generation: u64) {
        let (process, barrier, _) = place;
        self.open.remove(&place);
        self.passed.insert(place);
        self.inputs.entry(process).or_default().has_opened(BARRIERS[barrier].0, generation);
    }

    /// Records the restart of a process, which has had no input yet.
    pub(super) fn restarts(&mut self, process: usize) {
        self.inputs.remove(&process);
        self.grace_periods.remove(&process);
        self.lost.retain(|(other, ..), _| *other != process);
        self.absent.retain(|(other, ..), _| *other != process);
    }

    /// Records the end of a stall of all processes since that time.
    pub(super) fn stood_still(&mut self, since: Time, now: Time) {
        self.grace_periods.clear();
        for process in self.inputs.keys().copied() {
            let of_it = self.open.range((process, 0, 0)..(process + 1, 0, 0));
            let due =
                of_it.map(|(place, wait)| self.due(*place, wait)).chain(self.phases.due_of(process)).min();
            let late = due.map_or(Duration::ZERO, |due| now.since(due));
            let is_late = late > LATE;
            self.seen.put_off += u64::from(is_late);
            let least = if is_late { now + late.min(GRACE_PERIOD_MAX) } else { now };
            let most = now + now.since(since).min(GRACE_PERIOD_MAX);
            self.grace_periods.insert(process, GracePeriod { least, most });
        }
    }

    /// Records an input before a process handles it.
    pub(super) fn record_input(&mut self, process: usize, now: Time, input: &Input) {
        self.now = now;
        self.inputs.entry(process).or_default().record(input);
    }

    /// Records the end of a wait without an opening.
    pub(super) fn ends(&mut self, place: Place, answer: &BarrierAnswer) {
        let (process, barrier, _) = place;
        self.update_lost(process, barrier);
        let Some(wait) = self.open.get(&place) else { return };
        let (now, who, until) = (self.now, format!("{} of process {process}", wait.name), wait.until);
        let (missing, why_not) = match answer {
            BarrierAnswer::TimedOut { missing } => {
                (missing, (now < until).then(|| format!("has time until {until:?}")))
            }
            BarrierAnswer::Lost { missing } => (missing, self.why_not_lost(place, wait)),
            BarrierAnswer::Opened { .. } | BarrierAnswer::Refused { .. } => return,
        };
        let untimely = self.why_untimely(process, self.due(place, wait));
        for why_not in why_not.into_iter().chain(untimely) {
            self.violations.push(format!("at {now:?} {who} receives {answer:?}, but {why_not}"));
        }
        let wait = self.open.remove(&place).expect("it was found");
        self.over.insert(place, wait);
        let right = self.missing(process, barrier);
        let reported = missing.iter().map(|(name, why)| (&**name, &**why));
        self.check_reasons((process, BARRIERS[barrier].0), right, reported);
    }

    /// Returns why the end of a wait that was due at `due` is not reported in time.
    fn why_untimely(&self, process: usize, due: Time) -> Option<String> {
        let grace_period = self.grace_periods.get(&process);
        if grace_period.map_or(Time::ZERO, |grace_period| grace_period.most).max(due) < self.now {
            Some(format!("late, it was over at {due:?}"))
        } else if grace_period.is_some_and(|grace_period| self.now < grace_period.least) {
            Some("has not read all yet".to_owned())
        } else {
            None
        }
    }

    /// Returns why a wait may not be ended because of a loss now.
    fn why_not_lost(&self, (process, barrier, _): Place, wait: &Wait) -> Option<String> {
        if wait.on_loss == OnPartyLoss::Wait {
            return Some("wants to wait for the party's return".to_owned());
        }
        let since = self.lost_at(process, barrier).map(|lost| lost.perhaps).min();
        match since.map(|since| since.max(wait.since)) {
            None => Some("no party is lost".to_owned()),
            Some(since) if self.now < since + GRACE => Some(format!("the party is lost since {since:?}")),
            Some(_) => None,
        }
    }

    fn lost_at(&self, process: usize, barrier: usize) -> impl Iterator<Item = &Lost> {
        let of_it = self.lost.range((process, barrier, String::new())..(process, barrier + 1, String::new()));
        of_it.map(|(_, lost)| lost)
    }

    /// Returns the time at which a wait must be over.
    fn due(&self, (process, barrier, _): Place, wait: &Wait) -> Time {
        let surely = self.lost_at(process, barrier).filter_map(|lost| lost.surely).min();
        let lost = surely.filter(|_| wait.on_loss == OnPartyLoss::Fail);
        lost.map_or(wait.until, |lost| wait.until.min(lost.max(wait.since) + GRACE))
    }

    /// Checks the states of its barriers that a process reports after it has handled an input.
    pub(super) fn check_report(&mut self, process: usize, statuses: &[BarrierStatus]) {
        let of_it = |barrier: usize| statuses.iter().find(|status| status.barrier == BARRIERS[barrier].0);
        for barrier in 0..BARRIERS.len() {
            of_it(barrier).into_iter().for_each(|status| self.check_generation(process, status));
            self.update_lost(process, barrier);
            self.update_absent(process, barrier);
        }
        self.update_phases(process);
        self.remember(process);
        self.over.clear();
        self.passed.clear();
        self.phases.next_moment();
        for barrier in 0..BARRIERS.len() {
            self.check_waiting((process, barrier), of_it(barrier));
            of_it(barrier).into_iter().for_each(|status| self.check_missing((process, barrier), status));
        }
        self.check_deadlines(process);
        self.check_phases(process, statuses);
    }

    /// Checks that the process knows of as many openings as its inputs report.
    fn check_generation(&mut self, process: usize, status: &BarrierStatus) {
        let inputs = self.inputs.entry(process).or_default();
        let (reported, right) = (status.generation, inputs.generation(&status.barrier));
        if self.is_crowded {
            inputs.correct(&status.barrier, reported);
        } else if reported != right {
            let name = &status.barrier;
            self.violations
                .push(format!("process {process} says that {name} has opened {reported} times, not {right}"));
        }
    }

    /// Checks that exactly the waiting applications are reported as waiting, with the right times.
    fn check_waiting(&mut self, (process, barrier): (usize, usize), status: Option<&BarrierStatus>) {
        let reported: Vec<_> = status.into_iter().flat_map(|status| status.waiting.iter().cloned()).collect();
        let waits = self.open.range((process, barrier, 0)..(process, barrier + 1, 0));
        let right: Vec<_> = waits.map(|(_, wait)| (wait.name.clone(), self.now.since(wait.since))).collect();
        if reported != right {
            let name = BARRIERS[barrier].0;
            self.violations
                .push(format!("process {process} says that at {name} wait {reported:?}, not {right:?}"));
        }
    }

    fn check_missing(&mut self, (process, barrier): (usize, usize), status: &BarrierStatus) {
        let mut right = self.missing(process, barrier);
        for (name, reasons) in &mut right {
            let mutual = if self.is_crowded {
                self.may_wait_for_us((process, barrier), name)
            } else {
                self.waits_for_us((process, barrier), name)
            };
            if !mutual.is_empty() && !self.is_crowded {
                reasons.clear();
            }
            reasons.extend(mutual.into_iter().map(|why| (why, MUTUAL)));
        }
        let reported = status.missing.iter().map(|Absence { name, why, .. }| (&**name, &**why));
        self.check_reasons((process, BARRIERS[barrier].0), right, reported);
        let longest = status.waiting.iter().map(|(_, waited)| *waited).max().unwrap_or_default();
        for Absence { name, since, .. } in &status.missing {
            let absent = self.absent.get(&(process, barrier, name.clone()));
            let right = absent.map(|(_, at)| self.now.since(*at).min(longest));
            if right.is_some_and(|right| right != *since) {
                self.violations
                    .push(format!("{name} is reported as missing for {since:?}, and has been for {right:?}"));
            }
        }
    }

    /// Checks that exactly the missing parties are named, each with a right reason.
    fn check_reasons<'reported>(
        &mut self,
        (process, name): (usize, &str),
        right: Vec<(String, Vec<(String, &'static str)>)>,
        reported: impl Iterator<Item = (&'reported str, &'reported str)>,
    ) {
        let reported: Vec<(&str, &str)> = reported.collect();
        let find = |(name, reasons): &(String, Vec<(String, &'static str)>), reported: &(&str, &str)| {
            let reason = reasons.iter().find(|(words, _)| words == reported.1);
            reason.filter(|_| name == reported.0).map(|(_, kind)| *kind)
        };
        let found: Option<Vec<&'static str>> =
            right.iter().zip(&reported).map(|(right, reported)| find(right, reported)).collect();
        match found.filter(|_| reported.len() == right.len() && !reported.is_empty()) {
            Some(kinds) => {
                kinds.into_iter().for_each(|kind| *self.seen.reasons.entry(kind).or_default() += 1)
            }
            None => {
                self.violations.push(format!(
                    "at {:?} process {process} says that {name} lacks {reported:?}, and it lacks {right:?}",
                    self.now
                ));
            }
        }
    }

    /// Checks that no wait continues beyond its due time.
    fn check_deadlines(&mut self, process: usize) {
        let now = self.now;
        if self.grace_periods.get(&process).is_some_and(|grace_period| now < grace_period.most) {
            return;
        }
        let of_it = self.open.range((process, 0, 0)..(process + 1, 0, 0));
        let overdue = of_it.filter_map(|(place, wait)| {
            let (who, barrier, due) = (&wait.name, BARRIERS[place.1].0, self.due(*place, wait));
            let words = || format!("at {now:?} {who} of process {process} still waits at {barrier}, which was over at {due:?}");
            (due <= now).then(words)
        });
        let overdue: Vec<String> = overdue.collect();
        self.violations.extend(overdue);
    }

    /// Returns the applications that wait at a barrier by the inputs of a process, including those with a
    /// wait that ends at this moment.
    fn present(&self, process: usize, barrier: usize) -> Vec<&str> {
        let (from, to) = ((process, barrier, 0), (process, barrier + 1, 0));
        let own = self.open.range(from..to).chain(self.over.range(from..to)).map(|(_, wait)| &*wait.name);
        let (inputs, name) = (&self.inputs[&process], BARRIERS[barrier].0);
        let generation = inputs.generation(name);
        let elsewhere = inputs.waiting(name).filter(|(_, after)| *after == generation).map(|(name, _)| name);
        own.chain(elsewhere).collect()
    }

    /// Returns the parties missing at a barrier, and for each the right reasons with their kinds.
    fn missing(&self, process: usize, barrier: usize) -> Vec<(String, Vec<(String, &'static str)>)> {
        let present = self.present(process, barrier);
        let mut missing = Vec::new();
        for party in &self.parties[barrier] {
            let there = present.iter().filter(|name| party.counts(name)).count();
            if there >= party.count() {
                continue;
            }
            let reasons = match party.only_name() {
                Some(name) => {
                    let possible = self.inputs[&process].reasons(name, None).into_iter();
                    possible
                        .map(|why| why.map_or(READY, Reason::words))
                        .map(|why| (why.to_owned(), why))
                        .collect()
                }
                None => vec![(format!("{there} of {} have arrived", party.count()), COUNTED)],
            };
            missing.push((party.to_string(), reasons));
        }
        missing
    }

    /// Updates since when each awaited party is missing.
    fn update_absent(&mut self, process: usize, barrier: usize) {
        let is_awaited = self.open.range((process, barrier, 0)..(process, barrier + 1, 0)).next().is_some();
        let of_it = (process, barrier, String::new())..(process, barrier + 1, String::new());
        if !is_awaited && self.absent.range(of_it).next().is_none() {
            return;
        }
        let missing = if is_awaited { self.missing(process, barrier) } else { Vec::new() };
        let missing: BTreeSet<String> = missing.into_iter().map(|(party, _)| party).collect();
        let generation = self.inputs[&process].generation(BARRIERS[barrier].0);
        self.absent.retain(|(of, at, party), (after, _)| {
            (*of, *at) != (process, barrier) || (missing.contains(party) && *after == generation)
        });
        for party in missing {
            self.absent.entry((process, barrier, party)).or_insert((generation, self.now));
        }
    }

    fn update_lost(&mut self, process: usize, barrier: usize) {
        let present = self.present(process, barrier);
        let range = (process, barrier, 0)..(process, barrier + 1, 0);
        let is_awaited = self.open.range(range.clone()).chain(self.over.range(range)).next().is_some();
        let mut lost: Vec<(String, bool, bool)> = Vec::new();
        for name in self.parties[barrier].iter().filter_map(Requirement::only_name) {
            let is_missing = is_awaited && !present.contains(&name);
            let ends = self.inputs[&process].reasons(name, None).into_iter().map(is_end);
            let ends: Vec<bool> = ends.map(|is_end| is_end && is_missing).collect();
            lost.push((name.to_owned(), ends.contains(&true), !ends.contains(&false)));
        }
        let generation = self.inputs[&process].generation(BARRIERS[barrier].0);
        for (name, is_perhaps, is_surely) in lost {
            let key = (process, barrier, name);
            if is_perhaps {
                let begins = Lost { generation, perhaps: self.now, surely: None };
                let lost = self.lost.entry(key).or_insert(begins);
                if lost.generation != generation {
                    *lost = Lost { generation, perhaps: self.now, surely: None };
                }
                lost.surely = is_surely.then(|| lost.surely.unwrap_or(self.now));
            } else {
                self.lost.remove(&key);
            }
        }
    }

    /// Remembers the names that an application waits for.
    fn remember(&mut self, process: usize) {
        let names = |places: BTreeSet<usize>| -> BTreeSet<&str> {
            let parties = places.into_iter().flat_map(|barrier| &self.parties[barrier]);
            parties.flat_map(Requirement::alternatives).map(String::as_str).collect()
        };
        let barriers = |places: &mut dyn Iterator<Item = &Place>| -> BTreeSet<usize> {
            places.filter(|(other, ..)| *other == process).map(|(_, barrier, _)| *barrier).collect()
        };
        let awaited = barriers(&mut self.open.keys().chain(self.over.keys()));
        let passed = barriers(&mut self.passed.iter());
        let perhaps = awaited.union(&passed).copied().collect();
        let (mut awaited, mut perhaps) = (names(awaited), names(perhaps));
        awaited.extend(self.phases.awaited(process));
        perhaps.extend(self.phases.awaited(process));
        let inputs = self.inputs.get_mut(&process).expect("it has had an input");
        inputs.remember(awaited, perhaps);
    }
}
