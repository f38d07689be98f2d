//! Fault points: a supervised actor panics, hangs, stops or is slow on its n-th event, on purpose. For tests and demos.
//!
//! Only in builds with the feature `fault-points`: without it neither this module nor any call into it exists. What a
//! fault is and how it is written down is here, pure; [`FaultPoints`] makes it strike.
//!
//! An *event* is a message in the hand of an application, or what a layer takes out of its post. The n-th is counted
//! over all lives of the actor, from the start of its node or, for an injected fault, from the injection.
//!
//! ```
//! use sinew_runtime::supervision::fault::{Fault, FaultPlan};
//! use std::time::Duration;
//!
//! let plan: FaultPlan = "knee.drive:panic@1000, GNCL:hang(200ms)@5, hip.drive:slow(3ms)@100..200".parse()?;
//! assert_eq!(plan.faults()[1], ("GNCL".to_owned(), Fault::hang(Duration::from_millis(200)).at_event(5)));
//! # Ok::<(), sinew_runtime::supervision::fault::FaultError>(())
//! ```

mod point;

use std::{fmt, ops::Range, str::FromStr, time::Duration};

pub use self::point::{FaultPoints, INJECTED_MAX, Lives};
pub(crate) use self::point::{strike, strike_message};

/// What happens to the actor.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FaultKind {
    /// It panics, with the event in its hand.
    Panic,
    /// It blocks its thread for this time, or for ever.
    Hang(Option<Duration>),
    /// It ends by itself, in order.
    Stop,
    /// It blocks its thread for this time and then handles the event.
    Slow(Duration),
}

/// When it happens.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum FaultMoment {
    /// At its next turn, event or not.
    Now,
    /// On its n-th event, counted from 1.
    Event(u64),
    /// On each of these events; the end is not among them.
    Events(Range<u64>),
    /// On each n-th event.
    EveryEvents(u64),
    /// When it is started for the n-th time, before its actor is made.
    Start(u64),
}

/// A fault of one actor: what, and when.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Fault {
    /// What happens.
    pub kind: FaultKind,
    /// When.
    pub moment: FaultMoment,
}

impl Fault {
    const fn now(kind: FaultKind) -> Self {
        Self { kind, moment: FaultMoment::Now }
    }

    /// A panic at the next turn.
    #[must_use]
    pub const fn panic() -> Self {
        Self::now(FaultKind::Panic)
    }

    /// A turn that takes this long, next.
    #[must_use]
    pub const fn hang(time: Duration) -> Self {
        Self::now(FaultKind::Hang(Some(time)))
    }

    /// A next turn that never ends. Its thread stays until the process ends.
    #[must_use]
    pub const fn hang_for_ever() -> Self {
        Self::now(FaultKind::Hang(None))
    }

    /// An end by itself, next.
    #[must_use]
    pub const fn stop() -> Self {
        Self::now(FaultKind::Stop)
    }

    /// A next turn that takes this much longer.
    #[must_use]
    pub const fn slow(time: Duration) -> Self {
        Self::now(FaultKind::Slow(time))
    }

    /// The same on the n-th event, from 1.
    #[must_use]
    pub fn at_event(self, number: u64) -> Self {
        Self { moment: FaultMoment::Event(number), ..self }
    }

    /// The same on each of these events; the end is not among them.
    #[must_use]
    pub fn at_events(self, numbers: Range<u64>) -> Self {
        Self { moment: FaultMoment::Events(numbers), ..self }
    }

    /// The same on each n-th event.
    #[must_use]
    pub fn at_every(self, number: u64) -> Self {
        Self { moment: FaultMoment::EveryEvents(number), ..self }
    }

    /// The same at the n-th start, from 1.
    #[must_use]
    pub fn at_start(self, number: u64) -> Self {
        Self { moment: FaultMoment::Start(number), ..self }
    }
}

impl FaultMoment {
    /// Whether the event with this number, from 1, is struck.
    const fn strikes_event(&self, number: u64) -> bool {
        match self {
            Self::Event(at) => *at == number,
            Self::Events(range) => range.start <= number && number < range.end,
            Self::EveryEvents(every) => number.is_multiple_of(*every),
            Self::Now | Self::Start(_) => false,
        }
    }

    const fn strikes_start(&self, number: u64) -> bool {
        matches!(self, Self::Start(at) if *at == number)
    }

    /// Whether nothing can be struck any more after so many events and starts.
    const fn is_over(&self, events: u64, starts: u64) -> bool {
        match self {
            Self::Event(at) => events >= *at,
            Self::Events(range) => events + 1 >= range.end,
            Self::Start(at) => starts >= *at,
            // One is never over, the other when it has struck.
            Self::EveryEvents(_) | Self::Now => false,
        }
    }
}

impl fmt::Display for FaultKind {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Panic => f.write_str("panic"),
            Self::Hang(None) => f.write_str("hang"),
            Self::Hang(Some(time)) => write!(f, "hang({})", Shown(*time)),
            Self::Stop => f.write_str("stop"),
            Self::Slow(time) => write!(f, "slow({})", Shown(*time)),
        }
    }
}

impl fmt::Display for Fault {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let kind = &self.kind;
        match &self.moment {
            FaultMoment::Now => write!(f, "{kind}"),
            FaultMoment::Event(number) => write!(f, "{kind}@{number}"),
            FaultMoment::Events(range) => write!(f, "{kind}@{}..{}", range.start, range.end),
            FaultMoment::EveryEvents(number) => write!(f, "{kind}@every({number})"),
            FaultMoment::Start(number) => write!(f, "{kind}@start({number})"),
        }
    }
}

/// A time in the largest of the three units that shows it whole.
struct Shown(Duration);

impl fmt::Display for Shown {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let micros = self.0.as_micros();
        if micros.is_multiple_of(1_000_000) {
            write!(f, "{}s", micros / 1_000_000)
        } else if micros.is_multiple_of(1_000) {
            write!(f, "{}ms", micros / 1_000)
        } else {
            write!(f, "{micros}us")
        }
    }
}

/// A text that is no fault, or a fault that nobody can have. The caller's mistake; nothing was planned.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("fault `{fault}`: {why}")]
pub struct FaultError {
    /// What was given.
    pub fault: String,
    /// What is wrong with it, and what to write instead.
    pub why: String,
}

impl FaultError {
    fn new(fault: impl fmt::Display, why: impl Into<String>) -> Self {
        Self { fault: fault.to_string(), why: why.into() }
    }
}

const KINDS: &str = "write panic, stop, hang, hang(200ms) or slow(3ms)";
const MOMENTS: &str = "after @ write an event's number from 1 as in @1000, a range as in @100..200, @every(500), or \
                       @start(2); without @ it strikes at once";

impl FromStr for Fault {
    type Err = FaultError;

    fn from_str(text: &str) -> Result<Self, FaultError> {
        let text = text.trim();
        let (kind, moment) = match text.split_once('@') {
            Some((kind, moment)) => (kind, read_moment(moment.trim())),
            None => (text, Ok(FaultMoment::Now)),
        };
        let kind = read_kind(kind.trim()).map_err(|why| FaultError::new(text, why))?;
        let moment = moment.map_err(|why| FaultError::new(text, why))?;
        Ok(Self { kind, moment })
    }
}

fn read_kind(text: &str) -> Result<FaultKind, String> {
    match (text, in_brackets(text)) {
        ("panic", _) => Ok(FaultKind::Panic),
        ("stop", _) => Ok(FaultKind::Stop),
        ("hang", _) => Ok(FaultKind::Hang(None)),
        (_, Some(("hang", time))) => read_time(time).map(|time| FaultKind::Hang(Some(time))),
        (_, Some(("slow", time))) => read_time(time).map(FaultKind::Slow),
        ("slow", _) => Err("how slow? write slow(3ms)".to_owned()),
        (_, Some(_) | None) => Err(format!("`{text}` is nothing that can happen; {KINDS}")),
    }
}

fn read_moment(text: &str) -> Result<FaultMoment, String> {
    let wrong = || format!("`@{text}` is no moment; {MOMENTS}");
    let number = |text: &str| text.trim().parse().ok().filter(|number| *number > 0).ok_or_else(wrong);
    if let Some((start, end)) = text.split_once("..") {
        let range = number(start)?..number(end)?;
        if range.is_empty() {
            return Err(format!("`@{text}` has nothing in it; its end is not part of it and must be larger"));
        }
        return Ok(FaultMoment::Events(range));
    }
    match in_brackets(text) {
        Some(("every", every)) => number(every).map(FaultMoment::EveryEvents),
        Some(("start", start)) => number(start).map(FaultMoment::Start),
        Some(_) => Err(wrong()),
        None => number(text).map(FaultMoment::Event),
    }
}

/// `word(inside)`, taken apart.
fn in_brackets(text: &str) -> Option<(&str, &str)> {
    let (word, rest) = text.split_once('(')?;
    Some((word.trim(), rest.strip_suffix(')')?.trim()))
}

/// Longest time that can be planned: an hour, so that a slip of the pen is noticed.
const TIME_MAX: Duration = Duration::from_secs(3_600);

fn read_time(text: &str) -> Result<Duration, String> {
    let wrong = || {
        format!(
            "`{text}` is no time; write a whole number and its unit, us, ms or s, as in 200ms; at most 3600s"
        )
    };
    let digits = text.bytes().take_while(u8::is_ascii_digit).count();
    let (number, unit) = text.split_at(digits);
    let number: u64 = number.parse().map_err(|_| wrong())?;
    let time = match unit.trim() {
        "us" => Duration::from_micros(number),
        "ms" => Duration::from_millis(number),
        "s" => Duration::from_secs(number),
        _ => return Err(wrong()),
    };
    if time > TIME_MAX { Err(wrong()) } else { Ok(time) }
}

/// Faults of several actors, each under its actor's name: `NAME:FAULT, NAME:FAULT`.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FaultPlan(Vec<(String, Fault)>);

/// Faults in one plan at most.
const PLANNED_MAX: usize = 1_024;

impl FaultPlan {
    /// The faults, each with the name of its actor, in the order in which they were written.
    #[must_use]
    pub fn faults(&self) -> &[(String, Fault)] {
        &self.0
    }
}

impl FromStr for FaultPlan {
    type Err = FaultError;

    fn from_str(text: &str) -> Result<Self, FaultError> {
        let entries = text.split([',', ';', '\n']).map(str::trim).filter(|entry| !entry.is_empty());
        let plan: Vec<_> = entries.take(PLANNED_MAX + 1).map(read_entry).collect::<Result<_, _>>()?;
        if plan.len() > PLANNED_MAX {
            return Err(FaultError::new("...", format!("more than {PLANNED_MAX} faults in one plan")));
        }
        Ok(Self(plan))
    }
}

fn read_entry(entry: &str) -> Result<(String, Fault), FaultError> {
    // A name may have a colon in it; a fault has none.
    let Some((name, fault)) = entry.rsplit_once(':').filter(|(name, _)| !name.trim().is_empty()) else {
        return Err(FaultError::new(
            entry,
            "whose? write the actor's name before it, as in knee.drive:panic@1000",
        ));
    };
    let fault = fault.parse().map_err(|error: FaultError| FaultError::new(entry, error.why))?;
    Ok((name.trim().to_owned(), fault))
}

impl fmt::Display for FaultPlan {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        for (index, (name, fault)) in self.0.iter().enumerate() {
            let comma = if index == 0 { "" } else { ", " };
            write!(f, "{comma}{name}:{fault}")?;
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests;
