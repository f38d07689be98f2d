//! The fate of every message of all posters, including killed ones. Pure: entries in, an account out.

use std::{
    collections::{BTreeMap, BTreeSet},
    fmt,
};

use sinew::{Class, Outcome, Time, message::Rejection};

use super::entry::{Entry, Poster, Way};
use sinew_testkit::history::Numbers;

/// Maximum number of faults described in words; all are counted.
const FAULTS_SHOWN: usize = 20;

/// The fate of one message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Fate {
    /// Handled, and confirmed to the sender if requested.
    Delivered,
    /// Replaced by a newer value of the same Stream.
    Superseded,
    /// Rejected, and the sender was notified.
    Rejected,
    /// Expired before it was handled.
    Expired,
    /// The destination was killed while it held the message.
    Failed,
    /// The outcome was not known in time; handled or not.
    Unknown,
    /// The send returned an error at once.
    NotSent,
    /// Unconfirmed, to an incarnation of the destination that was killed or had not started.
    LostWithDestination,
    /// Among the last ones of a killed sender: nobody waits for their outcome any more.
    EndedWithSource,
    /// In flight.
    InFlight,
}

impl Fate {
    /// All variants, in the order of the law.
    pub const ALL: [Self; 10] = [
        Self::Delivered,
        Self::Superseded,
        Self::Rejected,
        Self::Expired,
        Self::Failed,
        Self::Unknown,
        Self::NotSent,
        Self::LostWithDestination,
        Self::EndedWithSource,
        Self::InFlight,
    ];
}

/// The first and the last number received by one incarnation of a destination.
#[derive(Clone, Copy, Debug)]
struct Run {
    first: u64,
    last: u64,
}

/// The messages of one incarnation of a source to one destination in one class, numbered from 1.
#[derive(Debug, Default)]
struct Track {
    sent: u64,
    /// Time just before the send of the batch that starts with this number.
    batches: Vec<(u64, Time)>,
    asked: BTreeMap<u64, Option<Outcome>>,
    not_sent: BTreeSet<u64>,
    handled: Numbers,
    /// By incarnation of the destination.
    runs: BTreeMap<u32, Run>,
}

impl Track {
    fn sends(&mut self, first: u64, count: u64, at: Time) -> Result<(), String> {
        if first != self.sent + 1 {
            return Err(format!("number {first} follows {}", self.sent));
        }
        self.sent += count;
        self.batches.push((first, at));
        Ok(())
    }

    fn got(&mut self, number: u64, incarnation: u32) -> Result<(), String> {
        if !self.handled.insert(number) {
            return Err(format!("number {number} came twice"));
        }
        let run = self.runs.entry(incarnation).or_insert(Run { first: number, last: 0 });
        if number < run.last {
            return Err(format!("number {number} came after {}", run.last));
        }
        run.last = number;
        Ok(())
    }

    fn sent_at(&self, number: u64) -> Time {
        let behind = self.batches.partition_point(|(first, _)| *first <= number);
        behind.checked_sub(1).map_or(Time::MAX, |index| self.batches[index].1)
    }
}

/// One incarnation of a poster.
#[derive(Clone, Copy, Debug, Default)]
struct IncarnationState {
    up: Option<Time>,
    killed: bool,
    quiet: bool,
}

/// The sender: a poster in one of its incarnations.
type Source = (Poster, u32);

/// The collected entries. It outlives the posters.
#[derive(Debug, Default)]
pub struct FateTracker {
    incarnations: BTreeMap<Source, IncarnationState>,
    tracks: BTreeMap<(Source, Way), Track>,
    /// The latest incarnation of a source that a destination has received from.
    latest: BTreeMap<(Source, Poster, Class), u32>,
    got: u64,
    faults: Vec<String>,
}

impl FateTracker {
    /// Adds an entry of the poster in this incarnation of its process.
    pub fn note(&mut self, poster: Poster, incarnation: u32, entry: Entry) {
        let source = (poster, incarnation);
        let noted = match entry {
            Entry::Up(at) => {
                self.incarnations.entry(source).or_default().up = Some(at);
                Ok(())
            }
            Entry::Quiet => {
                self.incarnations.entry(source).or_default().quiet = true;
                Ok(())
            }
            Entry::Sends(way, first, count, at) => self.track(source, way).sends(first, count, at),
            Entry::Asks(way, number, at) => {
                let track = self.track(source, way);
                track.asked.insert(number, None);
                track.sends(number, 1, at)
            }
            Entry::NotSent(way, number) => {
                let track = self.track(source, way);
                track.asked.remove(&number);
                if track.not_sent.insert(number) { Ok(()) } else { Err("reported twice".to_owned()) }
            }
            Entry::Outcome(way, number, outcome) => {
                match self.track(source, way).asked.insert(number, Some(outcome)) {
                    Some(None) => Ok(()),
                    other => Err(format!("number {number} ends as {outcome:?} after {other:?}")),
                }
            }
            Entry::Got(from, from_incarnation, class, number) => {
                self.note_got(source, (from, from_incarnation), class, number)
            }
            Entry::Broken(why) => Err(why),
        };
        if let Err(fault) = noted {
            self.faults.push(format!("poster {poster} in incarnation {incarnation}: {fault}"));
        }
    }

    fn note_got(&mut self, me: Source, from: Source, class: Class, number: u64) -> Result<(), String> {
        self.got += 1;
        let latest = self.latest.entry((me, from.0, class)).or_default();
        let before = std::mem::replace(latest, from.1.max(*latest));
        let way = Way { to: me.0, class };
        self.track(from, way).got(number, me.1).map_err(|fault| format!("{fault}, {class:?} of {from:?}"))?;
        if from.1 < before {
            return Err(format!("{class:?} of {from:?} came after one of incarnation {before}"));
        }
        Ok(())
    }

    /// Records that this incarnation of the poster was killed.
    pub fn killed(&mut self, poster: Poster, incarnation: u32) {
        self.incarnations.entry((poster, incarnation)).or_default().killed = true;
    }

    /// Returns whether this incarnation has its address.
    #[must_use]
    pub fn is_up(&self, poster: Poster, incarnation: u32) -> bool {
        self.incarnations.get(&(poster, incarnation)).is_some_and(|state| state.up.is_some())
    }

    /// Returns whether every incarnation that was not killed has stopped sending.
    #[must_use]
    pub fn is_quiet(&self) -> bool {
        self.incarnations.values().all(|state| state.killed || state.quiet)
    }

    fn track(&mut self, source: Source, way: Way) -> &mut Track {
        self.tracks.entry((source, way)).or_default()
    }

    /// The fates of all messages so far.
    #[must_use]
    pub fn account(&self) -> Account {
        let mut account = Account { got: self.got, ..Account::default() };
        self.faults.iter().for_each(|fault| account.fault(fault.clone()));
        for ((source, way), track) in &self.tracks {
            account.ways += 1;
            if let Some(fault) = fault_of_runs(track) {
                account.fault(format!("{source:?} to {way:?}: {fault}"));
            }
            for number in 1..=track.sent {
                match self.fate(*source, *way, track, number) {
                    Ok(fate) => {
                        account.add(way.class, fate);
                        if fate == Fate::InFlight {
                            let Track { sent, runs, .. } = track;
                            account.show(format!(
                                "on its way: {number} of {sent}, {source:?} to {way:?}, which got {runs:?}"
                            ));
                        }
                    }
                    Err(fault) => account.fault(format!("{source:?} to {way:?}, number {number}: {fault}")),
                }
                account.handled += u64::from(track.handled.has(number));
            }
        }
        account.confirmed = self.tracks.values().map(|track| track.asked.len() as u64).sum();
        let outcomes = self.tracks.values().flat_map(|track| track.asked.values());
        account.confirmed_delivered =
            outcomes.filter(|outcome| **outcome == Some(Outcome::Delivered)).count() as u64;
        account.killed = self.incarnations.values().filter(|state| state.killed).count() as u64;
        account
    }

    fn fate(&self, source: Source, way: Way, track: &Track, number: u64) -> Result<Fate, String> {
        let handled = track.handled.has(number);
        if track.not_sent.contains(&number) {
            return if handled { Err("handled, and not sent".to_owned()) } else { Ok(Fate::NotSent) };
        }
        match track.asked.get(&number) {
            Some(Some(outcome)) => self.fate_of_confirmed(way.to, *outcome, handled),
            _ if handled => Ok(Fate::Delivered),
            Some(None) if self.is_killed(source) => Ok(Fate::EndedWithSource),
            Some(None) => Ok(Fate::InFlight),
            None => self.fate_of_missing(source, way, track, number),
        }
    }

    fn fate_of_confirmed(&self, to: Poster, outcome: Outcome, handled: bool) -> Result<Fate, String> {
        let lie = || Err(format!("it ends as {outcome:?}, and handled is {handled}"));
        match (outcome, handled) {
            (Outcome::Delivered, true) => Ok(Fate::Delivered),
            (Outcome::Rejected(Rejection::ByHandler), true) => Ok(Fate::Rejected),
            (Outcome::Delivered | Outcome::Rejected(Rejection::ByHandler), false) => lie(),
            (Outcome::Rejected(_), false) => Ok(Fate::Rejected),
            (Outcome::Expired, false) => Ok(Fate::Expired),
            (Outcome::Rejected(_) | Outcome::Expired, true) => lie(),
            (Outcome::Unknown, _) => Ok(Fate::Unknown),
            (Outcome::Failed, _) if self.incarnations_of(to).any(|(_, state)| state.killed) => {
                Ok(Fate::Failed)
            }
            (Outcome::Failed, _) => Err("it ends as Failed, and its destination never did".to_owned()),
            (Outcome::PeerLost, _) => Err("it ends as PeerLost within one node".to_owned()),
        }
    }

    /// The fate of an unconfirmed message that was not handled.
    fn fate_of_missing(&self, source: Source, way: Way, track: &Track, number: u64) -> Result<Fate, String> {
        let sent = track.sent_at(number);
        let was_up = |state: &IncarnationState| state.up.is_some_and(|up| up <= sent);
        let Some((expected_at, state)) =
            self.incarnations_of(way.to).filter(|(_, state)| was_up(state)).last()
        else {
            return Ok(Fate::LostWithDestination);
        };
        let last = track.runs.get(&expected_at).map_or(0, |run| run.last);
        if number < last && way.class == Class::Stream {
            Ok(Fate::Superseded)
        } else if number < last {
            Err(format!("incarnation {expected_at} of its destination got {last}, and not this one before"))
        } else if state.killed {
            Ok(Fate::LostWithDestination)
        } else if self.is_killed(source) {
            Ok(Fate::EndedWithSource)
        } else {
            Ok(Fate::InFlight)
        }
    }

    fn is_killed(&self, source: Source) -> bool {
        self.incarnations.get(&source).is_some_and(|state| state.killed)
    }

    fn incarnations_of(&self, poster: Poster) -> impl Iterator<Item = (u32, &IncarnationState)> {
        self.incarnations.range((poster, 0)..=(poster, u32::MAX)).map(|((_, number), state)| (*number, state))
    }
}

/// Checks that each incarnation of the destination received only sent numbers, all above those of earlier
/// incarnations.
fn fault_of_runs(track: &Track) -> Option<String> {
    let mut before = 0;
    for (incarnation, run) in &track.runs {
        if run.first <= before {
            return Some(format!(
                "incarnation {incarnation} got {} after {before} had been there",
                run.first
            ));
        }
        before = run.last;
    }
    (before > track.sent).then(|| format!("number {before} came and was never sent"))
}

/// The fates of all messages.
#[derive(Clone, Debug, Default)]
pub struct Account {
    fates: BTreeMap<(Class, Fate), u64>,
    /// Number of triples of source, destination and class.
    pub ways: u64,
    /// Confirmed messages.
    pub confirmed: u64,
    /// Confirmed messages reported as delivered.
    pub confirmed_delivered: u64,
    /// Incarnations of posters that were killed.
    pub killed: u64,
    /// Messages received by posters.
    pub got: u64,
    handled: u64,
    /// Number of violations of the law.
    pub faults: u64,
    shown: Vec<String>,
}

impl Account {
    fn add(&mut self, class: Class, fate: Fate) {
        *self.fates.entry((class, fate)).or_default() += 1;
    }

    fn fault(&mut self, fault: String) {
        self.faults += 1;
        self.show(format!("FAULT {fault}"));
    }

    fn show(&mut self, what: String) {
        if self.shown.len() < FAULTS_SHOWN {
            self.shown.push(what);
        }
    }

    /// Messages with this fate, of all classes.
    #[must_use]
    pub fn of(&self, fate: Fate) -> u64 {
        self.fates.iter().filter(|((_, one), _)| *one == fate).map(|(_, count)| count).sum()
    }

    /// Messages that were sent.
    #[must_use]
    pub fn sent(&self) -> u64 {
        self.fates.values().sum::<u64>()
    }

    /// Returns whether no message is in flight, and every sent message has exactly one true fate.
    #[must_use]
    pub fn holds(&self) -> bool {
        self.faults == 0 && self.of(Fate::InFlight) == 0 && self.got == self.handled
    }
}

impl fmt::Display for Account {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { ways, confirmed, killed, got, faults, .. } = self;
        writeln!(
            f,
            "{ways} ways, {killed} incarnations killed, {confirmed} confirmed, {got} in hand, {faults} faults"
        )?;
        writeln!(f, "{:<20} {:>10} {:>10} {:>10}", "", "Control", "Stream", "Bulk")?;
        for fate in Fate::ALL {
            let count = |class| self.fates.get(&(class, fate)).copied().unwrap_or_default();
            let [control, stream, bulk] = [Class::Control, Class::Stream, Class::Bulk].map(count);
            writeln!(f, "{:<20} {control:>10} {stream:>10} {bulk:>10}", format!("{fate:?}"))?;
        }
        self.shown.iter().try_for_each(|fault| writeln!(f, "{fault}"))
    }
}

#[cfg(test)]
#[path = "fate_tracker_tests.rs"]
mod tests;
