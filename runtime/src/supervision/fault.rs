//! Fault points: a supervised actor panics, hangs, stops or is slow on its n-th event. For tests and demos.
//!
//! Only in builds with the feature `fault-points`: without it neither this module nor any call into it
//! exists. The definition and syntax of faults are here, pure; [`FaultPoints`] injects them.
//!
//! An *event* is a message that an application handles, or an event that a layer takes out of its queue. The
//! n-th is counted over all incarnations of the actor, from the start of its node or, for an injected fault,
//! from the injection.
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

/// The effect of a fault.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum FaultKind {
    /// The actor panics while it handles the event.
    Panic,
    /// The actor blocks its thread for this time, or forever.
    Hang(Option<Duration>),
    /// The actor ends itself, in order.
    Stop,
    /// The actor blocks its thread for this time and then handles the event.
    Slow(Duration),
}

/// The moment of a fault.
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum FaultMoment {
    /// At the actor's next turn, with or without an event.
    Now,
    /// At the actor's n-th event, counted from 1.
    Event(u64),
    /// At each of these events; the end is excluded.
    Events(Range<u64>),
    /// At each n-th event.
    EveryEvents(u64),
    /// At the n-th start of the actor, before it is created.
    Start(u64),
}

/// A fault of one actor: its effect and its moment.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Fault {
    /// The effect.
    pub kind: FaultKind,
    /// The moment.
    pub moment: FaultMoment,
}

impl Fault {
    const fn now(kind: FaultKind) -> Self {
        Self { kind, moment: FaultMoment::Now }
    }

    /// Returns a panic at the next turn.
    #[must_use]
    pub const fn panic() -> Self {
        Self::now(FaultKind::Panic)
    }

    /// Returns a next turn of this duration.
    #[must_use]
    pub const fn hang(time: Duration) -> Self {
        Self::now(FaultKind::Hang(Some(time)))
    }

    /// Returns a next turn that never ends. Its thread exists until the process ends.
    #[must_use]
    pub const fn hang_for_ever() -> Self {
        Self::now(FaultKind::Hang(None))
    }

    /// Returns an orderly end at the next turn.
    #[must_use]
    pub const fn stop() -> Self {
        Self::now(FaultKind::Stop)
    }

    /// Returns a next turn that takes this much longer.
    #[must_use]
    pub const fn slow(time: Duration) -> Self {
        Self::now(FaultKind::Slow(time))
    }

    /// Moves the fault to the n-th event, from 1.
    #[must_use]
    pub fn at_event(self, number: u64) -> Self {
        Self { moment: FaultMoment::Event(number), ..self }
    }

    /// Moves the fault to each of these events; the end is excluded.
    #[must_use]
    pub fn at_events(self, numbers: Range<u64>) -> Self {
        Self { moment: FaultMoment::Events(numbers), ..self }
    }

    /// Moves the fault to each n-th event.
    #[must_use]
    pub fn at_every(self, number: u64) -> Self {
        Self { moment: FaultMoment::EveryEvents(number), ..self }
    }

    /// Moves the fault to the n-th start, from 1.
    #[must_use]
    pub fn at_start(self, number: u64) -> Self {
        Self { moment: FaultMoment::Start(number), ..self }
    }
}

impl FaultMoment {
    /// Returns whether the fault affects the event with this number, from 1.
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

    /// Returns whether the fault can have no effect any more after this many events and starts.
    const fn is_over(&self, events: u64, starts: u64) -> bool {
        match self {
            Self::Event(at) => events >= *at,
            Self::Events(range) => events + 1 >= range.end,
            Self::Start(at) => starts >= *at,
            // The one never ends, the other is removed at its effect.
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

/// A duration, displayed in the largest of the three units that shows it exactly.
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

/// An invalid fault, or a fault that cannot be injected. This is an error of the caller; nothing was planned.
#[derive(Clone, Debug, PartialEq, Eq, thiserror::Error)]
#[error("fault `{fault}`: {why}")]
pub struct FaultError {
    /// The given text.
    pub fault: String,
    /// The cause, and the correct syntax.
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

/// Splits `word(inside)`.
fn in_brackets(text: &str) -> Option<(&str, &str)> {
    let (word, rest) = text.split_once('(')?;
    Some((word.trim(), rest.strip_suffix(')')?.trim()))
}

/// Maximum duration that can be planned: an hour, so that typing errors are detected.
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

/// The faults of several actors, each with its actor's name: `NAME:FAULT, NAME:FAULT`.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct FaultPlan(Vec<(String, Fault)>);

/// Maximum number of faults in one plan.
const PLANNED_MAX: usize = 1_024;

impl FaultPlan {
    /// Returns the faults, each with the name of its actor, in the order of the text.
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
    // A name may contain a colon; a fault does not.
    let Some((name, fault)) = entry.rsplit_once(':').filter(|(name, _)| !name.trim().is_empty()) else {
        return Err(FaultError::new(
            entry,
            "it names no actor; write the actor's name before it, as in knee.drive:panic@1000",
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
