//! The comparison of two runs, message by message.

use std::{collections::BTreeMap, fmt, time::Duration};

use sinew_runtime::{
    tid::Tid,
    time::Time,
    wire::{Flags, Kind},
};

use crate::{TimedMessage, value::Value};

/// Compares a recording with its replay: the messages of each source in their order, with destination,
/// type, class, flags and every byte. The flag KEEP is not compared, since the node decides on it. Names the first
/// difference. Use [`Comparison`] to compare times too, or to ignore a field.
///
/// # Errors
/// The first difference.
///
/// # Examples
///
/// ```
/// use sinew::replay::{TimedMessage, compare};
///
/// fn check(recorded: &[TimedMessage], replayed: &[TimedMessage]) {
///     if let Err(difference) = compare(recorded, replayed) {
///         panic!("{difference}");
///     }
/// }
/// ```
pub fn compare(recorded: &[TimedMessage], replayed: &[TimedMessage]) -> Result<(), FirstDifference> {
    Comparison::default().compare(recorded, replayed)
}

/// The terms of a comparison.
///
/// # Examples
///
/// ```
/// use sinew::{prelude::*, replay::{Comparison, FirstDifference, TimedMessage}};
///
/// /// A run on the wall clock beside its replay: timers were some microseconds late, and `t_ns` is the time of a turn.
/// fn check(recorded: &[TimedMessage], replayed: &[TimedMessage]) -> Result<(), FirstDifference> {
///     Comparison::default().times_within(Duration::from_millis(1)).ignoring("t_ns").compare(recorded, replayed)
/// }
/// ```
#[derive(Clone, Debug, Default)]
pub struct Comparison {
    times_within: Option<Duration>,
    ignored: Vec<String>,
}

impl Comparison {
    /// Compares the times of messages too: they may differ by at most `tolerance`. Zero: they are equal.
    #[must_use]
    pub const fn times_within(mut self, tolerance: Duration) -> Self {
        self.times_within = Some(tolerance);
        self
    }

    /// Ignores a field of all payloads, for example one with a time. A field of a field is `pose.t_ns`, an
    /// element of a list `samples[2]`.
    #[must_use]
    pub fn ignoring(mut self, field: impl Into<String>) -> Self {
        self.ignored.push(field.into());
        self
    }

    /// Compares; see [`compare`].
    ///
    /// # Errors
    /// The first difference: the earliest one, of any source.
    pub fn compare(
        &self,
        recorded: &[TimedMessage],
        replayed: &[TimedMessage],
    ) -> Result<(), FirstDifference> {
        type Messages<'a> = Vec<&'a TimedMessage>;
        let mut sources: BTreeMap<Tid, (Messages<'_>, Messages<'_>)> = BTreeMap::new();
        for message in recorded {
            sources.entry(message.source).or_default().0.push(message);
        }
        for message in replayed {
            sources.entry(message.source).or_default().1.push(message);
        }
        let differences =
            sources.iter().filter_map(|(source, (was, is))| self.first_of_source(*source, was, is));
        differences.min_by_key(|difference| difference.at).map_or(Ok(()), Err)
    }

    fn first_of_source(
        &self,
        source: Tid,
        recorded: &[&TimedMessage],
        replayed: &[&TimedMessage],
    ) -> Option<FirstDifference> {
        for index in 0..recorded.len().max(replayed.len()) {
            let (was, is) = (recorded.get(index).copied(), replayed.get(index).copied());
            let (message, what) = match (was, is) {
                (Some(was), Some(is)) => match self.difference(was, is) {
                    Some(what) => (was, what),
                    None => continue,
                },
                (Some(was), None) => {
                    (was, "it was sent in the recording, and is not in the replay".to_owned())
                }
                (None, Some(is)) => (is, "it was not sent in the recording, and is in the replay".to_owned()),
                (None, None) => return None,
            };
            return Some(FirstDifference {
                at: message.at,
                number: index + 1,
                sender: source,
                destination: message.destination,
                kind: message.kind,
                what,
                recorded: was.cloned().map(Box::new),
                replayed: is.cloned().map(Box::new),
            });
        }
        None
    }

    /// Returns how two messages differ, in words.
    fn difference(&self, was: &TimedMessage, is: &TimedMessage) -> Option<String> {
        let differ = |name: &str, was: &dyn fmt::Display, is: &dyn fmt::Display| {
            Some(format!("its {name} was {was} and is {is}"))
        };
        if was.kind != is.kind {
            return differ("type", &name_of(was.kind), &name_of(is.kind));
        }
        if was.destination != is.destination {
            return differ("destination", &was.destination, &is.destination);
        }
        if was.class != is.class {
            return differ("class", &format!("{:?}", was.class), &format!("{:?}", is.class));
        }
        // A node removes KEEP from a value that it has no room for.
        if was.flags.without(Flags::KEEP) != is.flags.without(Flags::KEEP) {
            return differ("flags", &format!("{:?}", was.flags), &format!("{:?}", is.flags));
        }
        if let Some(words) = self.payload(&was.payload, &is.payload) {
            return Some(words);
        }
        let apart = was.at.since(is.at).max(is.at.since(was.at));
        if self.times_within.is_some_and(|tolerance| apart > tolerance) {
            return differ("time", &format!("{:?}", was.at), &format!("{:?}", is.at));
        }
        None
    }

    fn payload(&self, was: &[u8], is: &[u8]) -> Option<String> {
        if was == is {
            return None;
        }
        let values = Value::of(was).zip(Value::of(is));
        if let Some((before, now)) = &values {
            let words = before.difference(now, &self.ignored);
            // Equal values may differ in bytes: in a form of the same number, or behind the value.
            if words.is_some() || !self.ignored.is_empty() {
                return words;
            }
        }
        let at = was.iter().zip(is).position(|(was, is)| was != is);
        Some(match at {
            Some(at) => format!("byte {at} of its payload was {:#04x} and is {:#04x}", was[at], is[at]),
            None => format!("its payload had {} bytes and has {}", was.len(), is.len()),
        })
    }
}

fn name_of(kind: Kind) -> String {
    kind.type_name().map_or_else(|| format!("kind {kind}"), str::to_owned)
}

/// The first message in which two runs differ.
///
/// # Examples
///
/// ```
/// use sinew::replay::FirstDifference;
///
/// fn report(difference: &FirstDifference) {
///     eprintln!("{difference}");
///     let lengths = [&difference.recorded, &difference.replayed].map(|side| side.as_ref().map(|m| m.payload.len()));
///     eprintln!("payloads: {lengths:?}");
/// }
/// ```
#[derive(Clone, Debug)]
pub struct FirstDifference {
    /// The time of the message: of the recorded one, if there is one.
    pub at: Time,
    /// The number of the message among those of its source, from 1.
    pub number: usize,
    /// The sender.
    pub sender: Tid,
    /// The destination.
    pub destination: Tid,
    /// The type of the payload.
    pub kind: Kind,
    /// The difference, in words.
    pub what: String,
    /// The recorded message.
    pub recorded: Option<Box<TimedMessage>>,
    /// The replayed message.
    pub replayed: Option<Box<TimedMessage>>,
}

impl fmt::Display for FirstDifference {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { at, number, sender, destination, kind, what, .. } = self;
        let kind = name_of(*kind);
        write!(f, "message {number} of {sender}, {kind} to {destination} at {at:?}: {what}")
    }
}

impl std::error::Error for FirstDifference {}
