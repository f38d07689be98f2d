//! What became of every message of all posters, killed ones too. Pure: entries in, an account out.

use std::{
    collections::{BTreeMap, BTreeSet},
    fmt,
};

use sinew::{Class, Outcome, Time, message::Rejection};

use super::entry::{Entry, Poster, Way};
use crate::numbers::Numbers;

/// Faults that an account tells in words; the others are counted.
const FAULTS_TOLD: usize = 20;

/// What became of one message.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Fate {
    /// It was handled, and its sender was told so if it asked.
    Delivered,
    /// A newer value of the same Stream took its place.
    Superseded,
    /// It was refused, and its sender told so.
    Rejected,
    /// It was too old before it was handled.
    Expired,
    /// Its destination was killed with it in hand.
    Failed,
    /// Nobody could say in time; handled or not.
    Unknown,
    /// Its sender was told at once that it was not sent.
    NotSent,
    /// Unconfirmed, to a life of its destination that was killed or had not begun.
    LostWithDestination,
    /// The last ones of a sender that was killed: nobody waits for their outcome any more.
    EndedWithSource,
    /// On its way.
    InFlight,
}

impl Fate {
    /// All, in the order of the law.
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

/// The first and the last number that one life of a destination got.
#[derive(Clone, Copy, Debug)]
struct Run {
    first: u64,
    last: u64,
}

/// The messages of one life of a source to one destination in one class. Their numbers begin with 1.
#[derive(Debug, Default)]
struct Track {
    sent: u64,
    /// When the batch that begins with this number was about to be sent.
    batches: Vec<(u64, Time)>,
    asked: BTreeMap<u64, Option<Outcome>>,
    not_sent: BTreeSet<u64>,
    handled: Numbers,
    /// By the life of the destination.
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

    fn got(&mut self, number: u64, life: u32) -> Result<(), String> {
        if !self.handled.insert(number) {
            return Err(format!("number {number} came twice"));
        }
        let run = self.runs.entry(life).or_insert(Run { first: number, last: 0 });
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

/// One life of a poster.
#[derive(Clone, Copy, Debug, Default)]
struct Life {
    up: Option<Time>,
    killed: bool,
    quiet: bool,
}

/// Who sends: a poster in one of its lives.
type Source = (Poster, u32);

/// Outlives the posters.
#[derive(Debug, Default)]
pub struct Ledger {
    lives: BTreeMap<Source, Life>,
    tracks: BTreeMap<(Source, Way), Track>,
    /// The latest life of a source that a destination heard of.
    heard: BTreeMap<(Source, Poster, Class), u32>,
    got: u64,
    faults: Vec<String>,
}

impl Ledger {
    /// What the poster said in this life of its process.
    pub fn note(&mut self, who: Poster, life: u32, entry: Entry) {
        let source = (who, life);
        let noted = match entry {
            Entry::Up(at) => {
                self.lives.entry(source).or_default().up = Some(at);
                Ok(())
            }
            Entry::Quiet => {
                self.lives.entry(source).or_default().quiet = true;
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
                if track.not_sent.insert(number) { Ok(()) } else { Err("told twice".to_owned()) }
            }
            Entry::Outcome(way, number, outcome) => {
                match self.track(source, way).asked.insert(number, Some(outcome)) {
                    Some(None) => Ok(()),
                    other => Err(format!("number {number} ends as {outcome:?} after {other:?}")),
                }
            }
            Entry::Got(from, from_life, class, number) => {
                self.note_got(source, (from, from_life), class, number)
            }
            Entry::Broken(why) => Err(why),
        };
        if let Err(fault) = noted {
            self.faults.push(format!("poster {who} in life {life}: {fault}"));
        }
    }

    fn note_got(&mut self, me: Source, from: Source, class: Class, number: u64) -> Result<(), String> {
        self.got += 1;
        let heard = self.heard.entry((me, from.0, class)).or_default();
        let before = std::mem::replace(heard, from.1.max(*heard));
        let way = Way { to: me.0, class };
        self.track(from, way).got(number, me.1).map_err(|fault| format!("{fault}, {class:?} of {from:?}"))?;
        if from.1 < before {
            return Err(format!("{class:?} of {from:?} came after one of life {before}"));
        }
        Ok(())
    }

    /// This life of the poster was killed.
    pub fn killed(&mut self, who: Poster, life: u32) {
        self.lives.entry((who, life)).or_default().killed = true;
    }

    /// Whether this life has its address.
    #[must_use]
    pub fn is_up(&self, who: Poster, life: u32) -> bool {
        self.lives.get(&(who, life)).is_some_and(|life| life.up.is_some())
    }

    /// Whether every life that was not killed sends no more.
    #[must_use]
    pub fn is_quiet(&self) -> bool {
        self.lives.values().all(|life| life.killed || life.quiet)
    }

    fn track(&mut self, source: Source, way: Way) -> &mut Track {
        self.tracks.entry((source, way)).or_default()
    }

    /// What became of everything so far.
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
                            account.tell(format!(
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
        account.killed = self.lives.values().filter(|life| life.killed).count() as u64;
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
            (Outcome::Failed, _) if self.lives_of(to).any(|(_, life)| life.killed) => Ok(Fate::Failed),
            (Outcome::Failed, _) => Err("it ends as Failed, and its destination never did".to_owned()),
            (Outcome::PeerLost, _) => Err("it ends as PeerLost within one node".to_owned()),
        }
    }

    /// An unconfirmed one that nobody has handled.
    fn fate_of_missing(&self, source: Source, way: Way, track: &Track, number: u64) -> Result<Fate, String> {
        let sent = track.sent_at(number);
        let was_up = |life: &Life| life.up.is_some_and(|up| up <= sent);
        let Some((owed_to, life)) = self.lives_of(way.to).filter(|(_, life)| was_up(life)).last() else {
            return Ok(Fate::LostWithDestination);
        };
        let last = track.runs.get(&owed_to).map_or(0, |run| run.last);
        if number < last && way.class == Class::Stream {
            Ok(Fate::Superseded)
        } else if number < last {
            Err(format!("life {owed_to} of its destination got {last}, and not this one before"))
        } else if life.killed {
            Ok(Fate::LostWithDestination)
        } else if self.is_killed(source) {
            Ok(Fate::EndedWithSource)
        } else {
            Ok(Fate::InFlight)
        }
    }

    fn is_killed(&self, source: Source) -> bool {
        self.lives.get(&source).is_some_and(|life| life.killed)
    }

    fn lives_of(&self, who: Poster) -> impl Iterator<Item = (u32, &Life)> {
        self.lives.range((who, 0)..=(who, u32::MAX)).map(|((_, number), life)| (*number, life))
    }
}

/// What one life of the destination got lies behind what the lives before it got, and was sent.
fn fault_of_runs(track: &Track) -> Option<String> {
    let mut before = 0;
    for (life, run) in &track.runs {
        if run.first <= before {
            return Some(format!("life {life} got {} after {before} had been there", run.first));
        }
        before = run.last;
    }
    (before > track.sent).then(|| format!("number {before} came and was never sent"))
}

/// What became of all messages.
#[derive(Clone, Debug, Default)]
pub struct Account {
    fates: BTreeMap<(Class, Fate), u64>,
    /// How many triples of source, destination and class there were.
    pub ways: u64,
    /// Messages whose sender waited for their outcome.
    pub confirmed: u64,
    /// Of these, those of which it is said that they were delivered.
    pub confirmed_delivered: u64,
    /// Lives of posters that were killed.
    pub killed: u64,
    /// Messages that posters had in hand.
    pub got: u64,
    handled: u64,
    /// How often the law was broken.
    pub faults: u64,
    told: Vec<String>,
}

impl Account {
    fn add(&mut self, class: Class, fate: Fate) {
        *self.fates.entry((class, fate)).or_default() += 1;
    }

    fn fault(&mut self, fault: String) {
        self.faults += 1;
        self.tell(format!("FAULT {fault}"));
    }

    fn tell(&mut self, what: String) {
        if self.told.len() < FAULTS_TOLD {
            self.told.push(what);
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

    /// Nothing is on its way, and every message that was sent has one fate that is true.
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
            "{ways} ways, {killed} lives killed, {confirmed} confirmed, {got} in hand, {faults} faults"
        )?;
        writeln!(f, "{:<20} {:>10} {:>10} {:>10}", "", "Control", "Stream", "Bulk")?;
        for fate in Fate::ALL {
            let count = |class| self.fates.get(&(class, fate)).copied().unwrap_or_default();
            let [control, stream, bulk] = [Class::Control, Class::Stream, Class::Bulk].map(count);
            writeln!(f, "{:<20} {control:>10} {stream:>10} {bulk:>10}", format!("{fate:?}"))?;
        }
        self.told.iter().try_for_each(|fault| writeln!(f, "{fault}"))
    }
}

#[cfg(test)]
#[path = "ledger_tests.rs"]
mod tests;
