//! What parties write down, one line each.

use std::{fmt, str::FromStr};

use sinew::{Class, Outcome};

/// An application that keeps its address over all lives of its process.
pub type Station = u16;

/// A station in one life of its process, from 1.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Party {
    /// Which one.
    pub station: Station,
    /// Which life of it.
    pub life: u32,
}

/// One thing that a party did or saw.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Note {
    /// It has sent so many messages from this number on, and waits for the outcome of each or of none.
    Sent {
        /// To whom.
        to: Station,
        /// Their class.
        class: Class,
        /// Their numbers follow each other; the first of all is 1.
        first: u64,
        /// How many.
        count: u64,
        /// Whether it waits for outcomes.
        asked: bool,
    },
    /// It was told this outcome.
    Ended {
        /// Of a message to this one.
        to: Station,
        /// Of this class.
        class: Class,
        /// With this number.
        number: u64,
        /// What it was told.
        outcome: Outcome,
    },
    /// It has got so many messages, one after the other. Of one whose sender waits, it says so before it lets go of it.
    Got {
        /// From this one.
        from: Party,
        /// Of this class.
        class: Class,
        /// From this number on.
        first: u64,
        /// How many.
        count: u64,
    },
    /// It has got a message that was not as it was sent.
    Damaged {
        /// From this one, as it says.
        from: Party,
        /// Of this class.
        class: Class,
        /// With this number, as it says.
        number: u64,
    },
    /// It was told that the other's node is lost.
    PeerLost {
        /// Whose.
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
            Self::Got { from: Party { station, life }, class, first, count } => {
                write!(f, "got {station} {life} {} {first} {count}", number_of(*class))
            }
            Self::Damaged { from: Party { station, life }, class, number } => {
                write!(f, "damaged {station} {life} {} {number}", number_of(*class))
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
    let party = |one: u64, life: u64| Some(Party { station: station(one)?, life: u32::try_from(life).ok()? });
    Some(match (verb, numbers) {
        ("sent" | "asked", &[to, in_class, first, count]) => {
            let (to, class) = (station(to)?, class(in_class)?);
            Note::Sent { to, class, first, count, asked: verb == "asked" }
        }
        ("ended", &[to, in_class, number, code]) => {
            let outcome = Outcome::from_code(u8::try_from(code).ok()?)?;
            Note::Ended { to: station(to)?, class: class(in_class)?, number, outcome }
        }
        ("got", &[from, life, in_class, first, count]) => {
            Note::Got { from: party(from, life)?, class: class(in_class)?, first, count }
        }
        ("damaged", &[from, life, in_class, number]) => {
            Note::Damaged { from: party(from, life)?, class: class(in_class)?, number }
        }
        ("lost", &[to, control, stream, bulk]) => {
            Note::PeerLost { to: station(to)?, upto: [control, stream, bulk] }
        }
        _ => return None,
    })
}
