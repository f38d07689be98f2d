//! The reports of a poster to the fate tracker, one line each.

use std::{fmt, str::FromStr};

use sinew::{Class, Outcome, Time};

/// A poster: the index of its address from 0, the same in every incarnation of its process.
pub type Poster = u16;

/// Destination and class of messages.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Way {
    /// The destination.
    pub to: Poster,
    /// The class.
    pub class: Class,
}

/// An action or observation of a poster.
#[derive(Clone, Debug, PartialEq)]
pub enum Entry {
    /// It has had its address since this time.
    Up(Time),
    /// It is about to send this many unconfirmed messages, starting at this number.
    Sends(Way, u64, u64, Time),
    /// It is about to send this confirmed message, and waits for its outcome.
    Asks(Way, u64, Time),
    /// This message was not sent, and the send returned an error at once.
    NotSent(Way, u64),
    /// The outcome of a confirmed message.
    Outcome(Way, u64, Outcome),
    /// It has received a message from this poster in this incarnation. It reports this before it settles the
    /// message.
    Got(Poster, u32, Class, u64),
    /// It sends no more messages.
    Quiet,
    /// It observed a violation.
    Broken(String),
}

const CLASSES: [Class; 3] = [Class::Control, Class::Stream, Class::Bulk];

fn number_of(class: Class) -> usize {
    CLASSES.iter().position(|one| *one == class).expect("all three are there")
}

impl fmt::Display for Entry {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let way = |way: &Way| format!("{} {}", way.to, number_of(way.class));
        match self {
            Self::Up(at) => write!(f, "up {}", at.as_nanos()),
            Self::Sends(to, first, count, at) => {
                write!(f, "sends {} {first} {count} {}", way(to), at.as_nanos())
            }
            Self::Asks(to, number, at) => write!(f, "asks {} {number} {}", way(to), at.as_nanos()),
            Self::NotSent(to, number) => write!(f, "not-sent {} {number}", way(to)),
            Self::Outcome(to, number, outcome) => {
                write!(f, "outcome {} {number} {}", way(to), outcome.code())
            }
            Self::Got(from, incarnation, class, number) => {
                write!(f, "got {from} {incarnation} {} {number}", number_of(*class))
            }
            Self::Quiet => f.write_str("quiet"),
            Self::Broken(why) => write!(f, "broken {}", why.replace('\n', " ")),
        }
    }
}

impl FromStr for Entry {
    type Err = String;

    fn from_str(line: &str) -> Result<Self, String> {
        let (verb, rest) = line.split_once(' ').unwrap_or((line, ""));
        if verb == "broken" {
            return Ok(Self::Broken(rest.to_owned()));
        }
        let numbers: Result<Vec<u64>, _> = rest.split_whitespace().map(str::parse).collect();
        let numbers = numbers.map_err(|error| format!("{line:?}: {error}"))?;
        read(verb, &numbers).ok_or_else(|| format!("{line:?} is no entry of a poster"))
    }
}

fn read(verb: &str, numbers: &[u64]) -> Option<Entry> {
    let class = |number: u64| CLASSES.get(usize::try_from(number).ok()?).copied();
    let poster = |number: u64| Poster::try_from(number).ok();
    let way = |to: u64, number: u64| Some(Way { to: poster(to)?, class: class(number)? });
    Some(match (verb, numbers) {
        ("up", &[at]) => Entry::Up(Time::from_nanos(at)),
        ("sends", &[to, in_class, first, count, at]) => {
            Entry::Sends(way(to, in_class)?, first, count, Time::from_nanos(at))
        }
        ("asks", &[to, in_class, number, at]) => {
            Entry::Asks(way(to, in_class)?, number, Time::from_nanos(at))
        }
        ("not-sent", &[to, in_class, number]) => Entry::NotSent(way(to, in_class)?, number),
        ("outcome", &[to, in_class, number, code]) => {
            Entry::Outcome(way(to, in_class)?, number, Outcome::from_code(u8::try_from(code).ok()?)?)
        }
        ("got", &[from, incarnation, in_class, number]) => {
            Entry::Got(poster(from)?, u32::try_from(incarnation).ok()?, class(in_class)?, number)
        }
        ("quiet", []) => Entry::Quiet,
        _ => return None,
    })
}

#[cfg(test)]
mod tests {
    use sinew::message::Rejection;

    use super::*;

    #[test]
    fn every_entry_survives_a_round_trip() {
        let (way, at) = (Way { to: 63, class: Class::Stream }, Time::from_nanos(12));
        for entry in [
            Entry::Up(at),
            Entry::Sends(way, 3, 16, at),
            Entry::Asks(way, 4, at),
            Entry::NotSent(way, 5),
            Entry::Outcome(way, 6, Outcome::Rejected(Rejection::Down)),
            Entry::Got(1, 2, Class::Bulk, 7),
            Entry::Quiet,
            Entry::Broken("for a reason".to_owned()),
        ] {
            assert_eq!(entry.to_string().parse(), Ok(entry));
        }
        assert!("got 1 2".parse::<Entry>().is_err() && "up x".parse::<Entry>().is_err());
    }
}
