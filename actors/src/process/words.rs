//! What a node and a process that it started say to each other; byte by byte in `docs/protocol/process.md`.

use bytes::Bytes;
use serde::{Deserialize, Serialize};
use sinew_runtime::{
    outcome::Outcome,
    supervision::Reason,
    tid::Tid,
    wire::{Header, Kind, Message},
};

use crate::lncl::payload;

/// The environment variable that makes a program host one application.
pub(super) const VARIABLE: &str = "SINEW_HOST";
/// Messages that the child has and has not handled, at most.
pub(super) const WINDOW: usize = 32;
/// Events of the node's layers that it may have beyond that: they go past a child that takes nothing else.
pub(super) const EVENTS_MAX: usize = 32;
/// Names of the directory that a child has a copy of, at most. If there are more it asks, and so many are told when they
/// change; further ones it has to ask for each time.
pub(super) const NAMES_MAX: usize = 1_024;

/// The node's first words.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Welcome {
    /// The application's TID.
    pub(super) tid: u64,
    /// Number of the first wait for an outcome or a reply.
    pub(super) first_wait: u64,
    /// Sequence of the last message that a former process of this TID sent.
    pub(super) sequence: u64,
    /// Time between two signs of life, in microseconds; 0 = none are wanted.
    pub(super) beat_us: u64,
    /// Who has which name.
    pub(super) names: Names,
}

/// Who has a name.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Name {
    /// The name.
    pub(super) name: String,
    /// Its TID; none = nobody has it.
    pub(super) tid: Option<u64>,
    /// Whether the node tells when that changes.
    pub(super) watched: bool,
}

/// Who has some names now.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Names {
    /// Those that were asked for, or have changed.
    pub(super) names: Vec<Name>,
    /// Whether nobody has any name but those that the child was told.
    pub(super) complete: bool,
}

/// Longest frame of these, in bytes, whatever the longest payload of a message is: as many names as there may be.
pub(super) const WORDS_BYTES_MAX: usize = 256 * 1024;
/// Longest text in them, in bytes; longer ones are cut.
pub(super) const TEXT_BYTES_MAX: usize = 4 * 1024;

/// A sign of life.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Beat {
    /// The application's turn lasts too long, since then: the host's clock, in nanoseconds; 0: it does not.
    pub(super) stalled_since: u64,
}

/// Asks who has a name.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Look {
    /// The name.
    pub(super) name: String,
}

/// How the application ended, or what it hangs in.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Ending {
    /// By itself, or because it was told to.
    Normal,
    /// It panicked; what it said.
    Panic(String),
    /// It lost what it requires and is to be started again when that is there; the name.
    RequirementLost(String),
    /// It does not come back; in what.
    Hung(String),
    /// It cannot start now; why.
    StartFailed(String),
    /// Something else, in words.
    Other(String),
}

impl From<&Reason> for Ending {
    fn from(reason: &Reason) -> Self {
        match reason {
            Reason::Normal | Reason::Shutdown => Self::Normal,
            Reason::RequirementLost(name) => Self::RequirementLost(name.clone()),
            Reason::Panic(said) => Self::Panic(cut(said)),
            Reason::Hung(what) => Self::Hung(cut(what)),
            Reason::StartFailed(why) => Self::StartFailed(cut(why)),
            other @ (Reason::StartTimeout
            | Reason::Killed
            | Reason::ThreadEnded
            | Reason::ProcessEnded(_)
            | Reason::GaveUp(_)) => Self::Other(cut(&other.to_string())),
        }
    }
}

fn cut(text: &str) -> String {
    text[..text.floor_char_boundary(TEXT_BYTES_MAX)].to_owned()
}

impl From<Ending> for Reason {
    fn from(ending: Ending) -> Self {
        match ending {
            Ending::Normal => Self::Normal,
            Ending::Panic(said) => Self::Panic(said),
            Ending::RequirementLost(name) => Self::RequirementLost(name),
            Ending::Hung(what) => Self::Hung(what),
            Ending::StartFailed(why) => Self::StartFailed(why),
            Ending::Other(what) => Self::ProcessEnded(what),
        }
    }
}

/// What became of a message that the child had.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Fate {
    /// It ended so.
    Ended(Outcome),
    /// A newer value of its Stream took its place.
    Superseded,
}

/// The byte for [`Fate::Superseded`]; no outcome has it.
const SUPERSEDED: u8 = 0xff;

/// A step of the child: a message has ended, the next one is taken into the hand.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Turn {
    /// This message has ended so.
    pub(super) done: Option<(u64, Fate)>,
    /// This message is in the hand from now on.
    pub(super) taken: Option<u64>,
}

impl Turn {
    /// The frame: `sequence` is the message taken, `correlation` the one that has ended, each 0 for none.
    pub(super) fn frame(self, tid: Tid) -> Message {
        let mut header = Header::new(Kind::HOST_TURN, tid, Tid::NONE);
        header.sequence = self.taken.unwrap_or(0);
        header.correlation = self.done.map_or(0, |(number, _)| number);
        let code = self.done.map_or(0, |(_, fate)| match fate {
            Fate::Ended(outcome) => outcome.code(),
            Fate::Superseded => SUPERSEDED,
        });
        Message::new(header, Bytes::copy_from_slice(&[code]))
    }

    /// Reads the frame; `None` if it is none.
    pub(super) fn read(message: &Message) -> Option<Self> {
        let [code] = message.payload[..] else { return None };
        let fate = match code {
            SUPERSEDED => Fate::Superseded,
            code => Fate::Ended(Outcome::from_code(code)?),
        };
        let number = |number: u64| (number != 0).then_some(number);
        let Header { sequence, correlation, .. } = message.header;
        Some(Self { done: number(correlation).map(|number| (number, fate)), taken: number(sequence) })
    }
}

/// A frame without a payload.
pub(super) fn bare(kind: Kind, source: Tid, destination: Tid) -> Message {
    Message::new(Header::new(kind, source, destination), Bytes::new())
}

/// A frame with a payload of ours.
pub(super) fn frame<P: Serialize>(kind: Kind, source: Tid, destination: Tid, payload: &P) -> Message {
    payload::frame(kind, source, destination, payload)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_turn_is_read_as_it_was_written() {
        let fates = [Fate::Superseded, Fate::Ended(Outcome::Delivered), Fate::Ended(Outcome::Failed)];
        let dones = fates.into_iter().map(|fate| Some((7, fate))).chain([None]);
        for done in dones {
            for taken in [None, Some(8)] {
                let turn = Turn { done, taken };
                assert_eq!(Turn::read(&turn.frame(Tid::NONE)), Some(turn));
            }
        }
    }

    #[test]
    fn what_is_no_turn_is_none() {
        let mut message = Turn::default().frame(Tid::NONE);
        message.payload = Bytes::from_static(&[9]);
        assert_eq!(Turn::read(&message), None);
        message.payload = Bytes::new();
        assert_eq!(Turn::read(&message), None);
    }
}
