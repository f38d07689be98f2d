//! What must hold of each wait: when it is over, who is told of a loss, and for whom and why it lasts. By what each process was told and says.

mod mutual;
mod phases;

use sinew_runtime::app::Requirement;

use self::phases::Phases;
use super::{told::Told, *};
use crate::sync::words::BarrierStatus;

/// From a loss until who does not wait for the party's return is told. // spec: SYNC-13
const PATIENCE: Duration = Duration::from_millis(50);
/// A process that was late by more has a respite before it says that a wait is over. // spec: SYNC-16
const LATE: Duration = Duration::from_millis(10);
/// A respite lasts so long at most. // spec: SYNC-16
pub(super) const RESPITE_MAX: Duration = Duration::from_millis(50);
/// Said of a party that could arrive.
const READY: &str = "ready, has not arrived";
/// How often those of a count have arrived is said of a party without a name of its own.
const COUNTED: &str = "so many of so many have arrived";
/// Said of a party that waits elsewhere for one of those who wait for it.
const MUTUAL: &str = "waits elsewhere for one who waits here";
/// Each reason that can be told here.
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

/// Whether this ends what was known of an application. // spec: SYNC-13
fn is_end(why: Option<Reason>) -> bool {
    let ends = [Reason::Failed, Reason::Stopped, Reason::Unregistered];
    let of_its_node = [Reason::NodeLeft, Reason::NodeLost, Reason::NodeRestarted];
    why.is_some_and(|why| ends.contains(&why) || of_its_node.contains(&why))
}

/// What an application asks for that arrives.
#[derive(Clone, Copy, Debug)]
pub(super) struct Asked {
    pub(super) since: Time,
    pub(super) within: Duration,
    pub(super) on_loss: OnPartyLoss,
}

/// A process, a barrier, and one of the applications of the process.
type Place = (usize, usize, usize);

/// One who waits.
struct Wait {
    name: String,
    since: Time,
    until: Time,
    on_loss: OnPartyLoss,
}

/// Since when a party that has ended is missing, and no word of an opening came: perhaps, and for sure.
struct Lost {
    /// How often the barrier had opened.
    generation: u64,
    perhaps: Time,
    surely: Option<Time>,
}

/// Time that a process has to read before it says that a wait is over.
struct Respite {
    /// It says so no earlier.
    least: Time,
    /// It may wait no longer.
    most: Time,
}

/// How often each reason was found to be right, so that a simulation which tries few is noticed; how many respites there were, and how many
/// waits at phases ended in each way: by an opening, by their deadlines, by a loss.
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
        assert!(REASONS.iter().all(is_tried), "hardly anything is told: {self:?}");
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
    told: BTreeMap<usize, Told>,
    now: Time,
    open: BTreeMap<Place, Wait>,
    /// Those that were still there when it was looked who is, and got another answer than an opening.
    over: BTreeMap<Place, Wait>,
    /// Those that have passed in this moment.
    passed: BTreeSet<Place>,
    /// Parties with a name that have ended and are missing, by process and barrier.
    lost: BTreeMap<(usize, usize, String), Lost>,
    /// Parties that are missing while somebody waits, by process and barrier: after how many openings, and since when.
    absent: BTreeMap<(usize, usize, String), (u64, Time)>,
    respites: BTreeMap<usize, Respite>,
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
            told: BTreeMap::new(),
            now: Time::ZERO,
            open: BTreeMap::new(),
            over: BTreeMap::new(),
            passed: BTreeSet::new(),
            lost: BTreeMap::new(),
            absent: BTreeMap::new(),
            respites: BTreeMap::new(),
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

    /// It gives up or dies.
    pub(super) fn leaves(&mut self, place: Place) {
        self.open.remove(&place);
    }

    pub(super) fn passes(&mut self, place: Place, generation: u64) {
        let (process, barrier, _) = place;
        self.open.remove(&place);
        self.passed.insert(place);
        self.told.entry(process).or_default().has_opened(BARRIERS[barrier].0, generation);
    }

    /// A process begins anew and has been told nothing.
    pub(super) fn restarts(&mut self, process: usize) {
        self.told.remove(&process);
        self.respites.remove(&process);
        self.lost.retain(|(other, ..), _| *other != process);
        self.absent.retain(|(other, ..), _| *other != process);
    }

    /// Nobody has run since then; now all go on.
    pub(super) fn stood_still(&mut self, since: Time, now: Time) {
        self.respites.clear();
        for process in self.told.keys().copied() {
            let of_it = self.open.range((process, 0, 0)..(process + 1, 0, 0));
            let due =
                of_it.map(|(place, wait)| self.due(*place, wait)).chain(self.phases.due_of(process)).min();
            let late = due.map_or(Duration::ZERO, |due| now.since(due));
            let is_late = late > LATE;
            self.seen.put_off += u64::from(is_late);
            let least = if is_late { now + late.min(RESPITE_MAX) } else { now };
            let most = now + now.since(since).min(RESPITE_MAX);
            self.respites.insert(process, Respite { least, most });
        }
    }

    /// A process is about to be told this.
    pub(super) fn is_told(&mut self, process: usize, now: Time, input: &Input) {
        self.now = now;
        self.told.entry(process).or_default().hears(input);
    }

    /// A wait ends without an opening.
    pub(super) fn ends(&mut self, place: Place, answer: &BarrierAnswer) {
        let (process, barrier, _) = place;
        self.look_who_is_lost(process, barrier);
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
            self.violations.push(format!("at {now:?} {who} is told {answer:?}, but {why_not}"));
        }
        let wait = self.open.remove(&place).expect("it was found");
        self.over.insert(place, wait);
        let right = self.missing(process, barrier);
        let said = missing.iter().map(|(name, why)| (&**name, &**why));
        self.check_reasons((process, BARRIERS[barrier].0), right, said);
    }

    /// Why the end of a wait that was to be over at `due` is not told in time.
    fn why_untimely(&self, process: usize, due: Time) -> Option<String> {
        let respite = self.respites.get(&process);
        if respite.map_or(Time::ZERO, |respite| respite.most).max(due) < self.now {
            Some(format!("late, it was over at {due:?}"))
        } else if respite.is_some_and(|respite| self.now < respite.least) {
            Some("has not read all yet".to_owned())
        } else {
            None
        }
    }

    /// Why a wait may not be ended because of a loss now.
    fn why_not_lost(&self, (process, barrier, _): Place, wait: &Wait) -> Option<String> {
        if wait.on_loss == OnPartyLoss::Wait {
            return Some("wants to wait for the party's return".to_owned());
        }
        let since = self.lost_at(process, barrier).map(|lost| lost.perhaps).min();
        match since.map(|since| since.max(wait.since)) {
            None => Some("no party is lost".to_owned()),
            Some(since) if self.now < since + PATIENCE => Some(format!("the party is lost since {since:?}")),
            Some(_) => None,
        }
    }

    fn lost_at(&self, process: usize, barrier: usize) -> impl Iterator<Item = &Lost> {
        let of_it = self.lost.range((process, barrier, String::new())..(process, barrier + 1, String::new()));
        of_it.map(|(_, lost)| lost)
    }

    /// When a wait has to be over.
    fn due(&self, (process, barrier, _): Place, wait: &Wait) -> Time {
        let surely = self.lost_at(process, barrier).filter_map(|lost| lost.surely).min();
        let lost = surely.filter(|_| wait.on_loss == OnPartyLoss::Fail);
        lost.map_or(wait.until, |lost| wait.until.min(lost.max(wait.since) + PATIENCE))
    }

    /// A process has done what it does about what it was told, and says how its barriers stand.
    pub(super) fn says(&mut self, process: usize, statuses: &[BarrierStatus]) {
        let of_it = |barrier: usize| statuses.iter().find(|status| status.barrier == BARRIERS[barrier].0);
        for barrier in 0..BARRIERS.len() {
            of_it(barrier).into_iter().for_each(|status| self.check_generation(process, status));
            self.look_who_is_lost(process, barrier);
            self.look_who_is_absent(process, barrier);
        }
        self.look_at_phases(process);
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

    /// It knows of as many openings as it was told of.
    fn check_generation(&mut self, process: usize, status: &BarrierStatus) {
        let told = self.told.entry(process).or_default();
        let (said, right) = (status.generation, told.generation(&status.barrier));
        if self.is_crowded {
            told.correct(&status.barrier, said);
        } else if said != right {
            let name = &status.barrier;
            self.violations
                .push(format!("process {process} says that {name} has opened {said} times, not {right}"));
        }
    }

    /// Whoever waits is said to, and nobody else, and for how long.
    fn check_waiting(&mut self, (process, barrier): (usize, usize), status: Option<&BarrierStatus>) {
        let said: Vec<_> = status.into_iter().flat_map(|status| status.waiting.iter().cloned()).collect();
        let waits = self.open.range((process, barrier, 0)..(process, barrier + 1, 0));
        let right: Vec<_> = waits.map(|(_, wait)| (wait.name.clone(), self.now.since(wait.since))).collect();
        if said != right {
            let name = BARRIERS[barrier].0;
            self.violations
                .push(format!("process {process} says that at {name} wait {said:?}, not {right:?}"));
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
        let said = status.missing.iter().map(|Absence { name, why, .. }| (&**name, &**why));
        self.check_reasons((process, BARRIERS[barrier].0), right, said);
        let longest = status.waiting.iter().map(|(_, waited)| *waited).max().unwrap_or_default();
        for Absence { name, since, .. } in &status.missing {
            let absent = self.absent.get(&(process, barrier, name.clone()));
            let right = absent.map(|(_, at)| self.now.since(*at).min(longest));
            if right.is_some_and(|right| right != *since) {
                self.violations
                    .push(format!("{name} is said to be missing for {since:?}, and has been for {right:?}"));
            }
        }
    }

    /// Whoever is missing is named with a reason that is right, and nobody else.
    fn check_reasons<'said>(
        &mut self,
        (process, name): (usize, &str),
        right: Vec<(String, Vec<(String, &'static str)>)>,
        said: impl Iterator<Item = (&'said str, &'said str)>,
    ) {
        let said: Vec<(&str, &str)> = said.collect();
        let find = |(name, reasons): &(String, Vec<(String, &'static str)>), said: &(&str, &str)| {
            let reason = reasons.iter().find(|(words, _)| words == said.1);
            reason.filter(|_| name == said.0).map(|(_, kind)| *kind)
        };
        let found: Option<Vec<&'static str>> =
            right.iter().zip(&said).map(|(right, said)| find(right, said)).collect();
        match found.filter(|_| said.len() == right.len() && !said.is_empty()) {
            Some(kinds) => {
                kinds.into_iter().for_each(|kind| *self.seen.reasons.entry(kind).or_default() += 1)
            }
            None => {
                self.violations.push(format!(
                    "at {:?} process {process} says that {name} lacks {said:?}, and it lacks {right:?}",
                    self.now
                ));
            }
        }
    }

    /// No wait goes on that has to be over.
    fn check_deadlines(&mut self, process: usize) {
        let now = self.now;
        if self.respites.get(&process).is_some_and(|respite| now < respite.most) {
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

    /// Who waits at a barrier, as a process was told; those whose time is over in this moment, too.
    fn present(&self, process: usize, barrier: usize) -> Vec<&str> {
        let (from, to) = ((process, barrier, 0), (process, barrier + 1, 0));
        let own = self.open.range(from..to).chain(self.over.range(from..to)).map(|(_, wait)| &*wait.name);
        let (told, name) = (&self.told[&process], BARRIERS[barrier].0);
        let generation = told.generation(name);
        let elsewhere = told.waiting(name).filter(|(_, after)| *after == generation).map(|(name, _)| name);
        own.chain(elsewhere).collect()
    }

    /// Who is missing at a barrier, and each reason that is right, with what sort of reason it is.
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
                    let standing = self.told[&process].standing(name, None).into_iter();
                    standing
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

    /// Since when each party is missing for whom somebody waits.
    fn look_who_is_absent(&mut self, process: usize, barrier: usize) {
        let is_awaited = self.open.range((process, barrier, 0)..(process, barrier + 1, 0)).next().is_some();
        let of_it = (process, barrier, String::new())..(process, barrier + 1, String::new());
        if !is_awaited && self.absent.range(of_it).next().is_none() {
            return;
        }
        let missing = if is_awaited { self.missing(process, barrier) } else { Vec::new() };
        let missing: BTreeSet<String> = missing.into_iter().map(|(party, _)| party).collect();
        let generation = self.told[&process].generation(BARRIERS[barrier].0);
        self.absent.retain(|(of, at, party), (after, _)| {
            (*of, *at) != (process, barrier) || (missing.contains(party) && *after == generation)
        });
        for party in missing {
            self.absent.entry((process, barrier, party)).or_insert((generation, self.now));
        }
    }

    fn look_who_is_lost(&mut self, process: usize, barrier: usize) {
        let present = self.present(process, barrier);
        let range = (process, barrier, 0)..(process, barrier + 1, 0);
        let is_awaited = self.open.range(range.clone()).chain(self.over.range(range)).next().is_some();
        let mut lost: Vec<(String, bool, bool)> = Vec::new();
        for name in self.parties[barrier].iter().filter_map(Requirement::only_name) {
            let is_missing = is_awaited && !present.contains(&name);
            let ends = self.told[&process].standing(name, None).into_iter().map(is_end);
            let ends: Vec<bool> = ends.map(|is_end| is_end && is_missing).collect();
            lost.push((name.to_owned(), ends.contains(&true), !ends.contains(&false)));
        }
        let generation = self.told[&process].generation(BARRIERS[barrier].0);
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

    /// Names that somebody waits for are remembered.
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
        let told = self.told.get_mut(&process).expect("it was told something");
        told.remember(awaited, perhaps);
    }
}
