//! The notes of the parties, one line each.

use std::{fmt, str::FromStr};

use sinew::{Class, Outcome};

/// An application that keeps its address over all incarnations of its process.
pub type Station = u16;

/// A station in one incarnation of its process, from 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Party {
    /// The station.
    pub station: Station,
    /// The incarnation.
    pub incarnation: u32,
}

/// An action or observation of a party.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Note {
    /// It has sent messages, all confirmed or all unconfirmed.
    Sent {
        /// The destination.
        to: Station,
        /// The class.
        class: Class,
        /// The first number of the consecutive range; the first message has number 1.
        first: u64,
        /// The number of messages.
        count: u64,
        /// Whether they are confirmed.
        asked: bool,
    },
    /// It has received an outcome.
    Ended {
        /// The destination of the message.
        to: Station,
        /// The class.
        class: Class,
        /// The number.
        number: u64,
        /// The outcome.
        outcome: Outcome,
    },
    /// It has received consecutive messages. A confirmed message is noted before it is released.
    Got {
        /// The source.
        from: Party,
        /// The class.
        class: Class,
        /// The first number.
        first: u64,
        /// The number of messages.
        count: u64,
    },
    /// It has received a corrupted message.
    Damaged {
        /// The claimed source.
        from: Party,
        /// The class.
        class: Class,
        /// The claimed number.
        number: u64,
    },
    /// It was notified that the other's node is lost.
    PeerLost {
        /// The other station.
        to: Station,
        /// The last numbers that it had sent there: of Control, Stream, Bulk.
        upto: [u64; 3],
    },
}

const CLASSES: [Class; 3] = [Class::Control, Class::Stream, Class::Bulk];

fn number_of(class: Class) -> usize {
    CLASSES.iter().position(|one| *one == class).expect("all three are there")
}

impl fmt::Display for Note {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::Sent { to, class, first, count, asked } => {
                let verb = if *asked { "asked" } else { "sent" };
                write!(f, "{verb} {to} {} {first} {count}", number_of(*class))
            }
            Self::Ended { to, class, number, outcome } => {
                write!(f, "ended {to} {} {number} {}", number_of(*class), outcome.code())
            }
            Self::Got { from: Party { station, incarnation }, class, first, count } => {
                write!(f, "got {station} {incarnation} {} {first} {count}", number_of(*class))
            }
            Self::Damaged { from: Party { station, incarnation }, class, number } => {
                write!(f, "damaged {station} {incarnation} {} {number}", number_of(*class))
            }
            Self::PeerLost { to, upto: [control, stream, bulk] } => {
                write!(f, "lost {to} {control} {stream} {bulk}")
            }
        }
    }
}

impl FromStr for Note {
    type Err = String;

    fn from_str(line: &str) -> Result<Self, String> {
        let (verb, rest) = line.split_once(' ').unwrap_or((line, ""));
        let numbers: Result<Vec<u64>, _> = rest.split_whitespace().map(str::parse).collect();
        let numbers = numbers.map_err(|error| format!("{line:?}: {error}"))?;
        read(verb, &numbers).ok_or_else(|| format!("{line:?} is nothing that a party writes down"))
    }
}

fn read(verb: &str, numbers: &[u64]) -> Option<Note> {
    let class = |number: u64| CLASSES.get(usize::try_from(number).ok()?).copied();
    let station = |number: u64| Station::try_from(number).ok();
    let party = |one: u64, incarnation: u64| {
        Some(Party { station: station(one)?, incarnation: u32::try_from(incarnation).ok()? })
    };
    Some(match (verb, numbers) {
        ("sent" | "asked", &[to, in_class, first, count]) => {
            let (to, class) = (station(to)?, class(in_class)?);
            Note::Sent { to, class, first, count, asked: verb == "asked" }
        }
        ("ended", &[to, in_class, number, code]) => {
            let outcome = Outcome::from_code(u8::try_from(code).ok()?)?;
            Note::Ended { to: station(to)?, class: class(in_class)?, number, outcome }
        }
        ("got", &[from, incarnation, in_class, first, count]) => {
            Note::Got { from: party(from, incarnation)?, class: class(in_class)?, first, count }
        }
        ("damaged", &[from, incarnation, in_class, number]) => {
            Note::Damaged { from: party(from, incarnation)?, class: class(in_class)?, number }
        }
        ("lost", &[to, control, stream, bulk]) => {
            Note::PeerLost { to: station(to)?, upto: [control, stream, bulk] }
        }
        _ => return None,
    })
}
