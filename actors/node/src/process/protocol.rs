//! The protocol between a node and a process that it started; `docs/protocol/process.md` specifies its bytes.

use bytes::Bytes;
use serde::{Deserialize, Serialize};
use sinew_runtime::{
    outcome::Outcome,
    supervision::Reason,
    tid::Tid,
    wire::{Header, Kind, Message},
};

use sinew_protocol::payload;

/// The environment variable that makes a program host one application.
pub(super) const VARIABLE: &str = "SINEW_HOST";
/// Maximum number of messages that the child holds unhandled.
pub(super) const WINDOW: usize = 32;
/// Maximum number of events of the node's layers at the child beyond [`WINDOW`]. They pass a child that takes
/// no other messages.
pub(super) const EVENTS_MAX: usize = 32;
/// Maximum number of directory names in a child's copy. If there are more, the child looks names up, and gets
/// the changes of this many. It looks up further names each time.
pub(super) const NAMES_MAX: usize = 1_024;

/// The node's first frame.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Welcome {
    /// The application's TID.
    pub(super) tid: u64,
    /// Number of the first wait for an outcome or a reply.
    pub(super) first_wait: u64,
    /// Sequence of the last message that a former process of this TID sent.
    pub(super) sequence: u64,
    /// Interval of the heartbeats, in microseconds; 0 = no heartbeats.
    pub(super) beat_us: u64,
    /// The owners of names.
    pub(super) names: Names,
}

/// The owner of a name.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Name {
    /// The name.
    pub(super) name: String,
    /// Its TID; none = the name is unused.
    pub(super) tid: Option<u64>,
    /// Whether the node sends changes of this name.
    pub(super) watched: bool,
}

/// The current owners of some names.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Names {
    /// The names that were looked up, or have changed.
    pub(super) names: Vec<Name>,
    /// Whether the child's copy holds all names in use.
    pub(super) complete: bool,
}

/// Maximum frame length in bytes, independent of the message payload limit: it holds the maximum number of
/// names.
pub(super) const FRAME_BYTES_MAX: usize = 256 * 1024;
/// Maximum length of a text in these frames, in bytes; longer texts are cut.
pub(super) const TEXT_BYTES_MAX: usize = 4 * 1024;

/// A heartbeat.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct Beat {
    /// Start of the application's stalled turn, by the host's clock in nanoseconds; 0 if no turn is stalled.
    pub(super) stalled_since: u64,
}

/// A lookup of a name.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct NameLookup {
    /// The name.
    pub(super) name: String,
}

/// The end of the application, or the place that it hangs in.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum ExitReport {
    /// It ended by itself, or because it was asked to.
    Normal,
    /// It panicked, with this text.
    Panic(String),
    /// It lost the requirement of this name, and must start again when that is ready.
    RequirementLost(String),
    /// It hangs, in this place.
    Hung(String),
    /// It cannot start now, for this reason.
    StartFailed(String),
    /// Another end, in words.
    Other(String),
}

impl From<&Reason> for ExitReport {
    fn from(reason: &Reason) -> Self {
        match reason {
            Reason::Normal | Reason::Shutdown => Self::Normal,
            Reason::RequirementLost(name) => Self::RequirementLost(name.clone()),
            Reason::Panic(text) => Self::Panic(truncate(text)),
            Reason::Hung(what) => Self::Hung(truncate(what)),
            Reason::StartFailed(why) => Self::StartFailed(truncate(why)),
            other @ (Reason::StartTimeout
            | Reason::Killed
            | Reason::ThreadEnded
            | Reason::ProcessEnded(_)
            | Reason::GaveUp(_)) => Self::Other(truncate(&other.to_string())),
        }
    }
}

fn truncate(text: &str) -> String {
    text[..text.floor_char_boundary(TEXT_BYTES_MAX)].to_owned()
}

impl From<ExitReport> for Reason {
    fn from(ending: ExitReport) -> Self {
        match ending {
            ExitReport::Normal => Self::Normal,
            ExitReport::Panic(text) => Self::Panic(text),
            ExitReport::RequirementLost(name) => Self::RequirementLost(name),
            ExitReport::Hung(what) => Self::Hung(what),
            ExitReport::StartFailed(why) => Self::StartFailed(why),
            ExitReport::Other(what) => Self::ProcessEnded(what),
        }
    }
}

/// The disposition of a message that the child held.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Disposition {
    /// It has this outcome.
    Ended(Outcome),
    /// A newer value of its Stream replaced it.
    Superseded,
}

/// The byte of [`Disposition::Superseded`]; no outcome uses it.
const SUPERSEDED: u8 = 0xff;

/// A step of the child: a message has ended, and the next one is taken.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Progress {
    /// The message that has ended, and its disposition.
    pub(super) done: Option<(u64, Disposition)>,
    /// The message that is handled from now on.
    pub(super) taken: Option<u64>,
}

impl Progress {
    /// Returns the frame. `sequence` is the message taken, `correlation` the message that has ended; 0 for
    /// none.
    pub(super) fn frame(self, tid: Tid) -> Message {
        let mut header = Header::new(Kind::HOST_TURN, tid, Tid::NONE);
        header.sequence = self.taken.unwrap_or(0);
        header.correlation = self.done.map_or(0, |(number, _)| number);
        let code = self.done.map_or(0, |(_, disposition)| match disposition {
            Disposition::Ended(outcome) => outcome.code(),
            Disposition::Superseded => SUPERSEDED,
        });
        Message::new(header, Bytes::copy_from_slice(&[code]))
    }

    /// Parses the frame. Returns `None` if it is malformed.
    pub(super) fn read(message: &Message) -> Option<Self> {
        let [code] = message.payload[..] else { return None };
        let disposition = match code {
            SUPERSEDED => Disposition::Superseded,
            code => Disposition::Ended(Outcome::from_code(code)?),
        };
        let number = |number: u64| (number != 0).then_some(number);
        let Header { sequence, correlation, .. } = message.header;
        Some(Self { done: number(correlation).map(|number| (number, disposition)), taken: number(sequence) })
    }
}

/// Returns a frame without a payload.
pub(super) fn empty_frame(kind: Kind, source: Tid, destination: Tid) -> Message {
    Message::new(Header::new(kind, source, destination), Bytes::new())
}

/// Returns a frame with a payload of this protocol.
pub(super) fn frame<P: Serialize>(kind: Kind, source: Tid, destination: Tid, payload: &P) -> Message {
    payload::frame(kind, source, destination, payload)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turn_round_trips() {
        let dispositions = [
            Disposition::Superseded,
            Disposition::Ended(Outcome::Delivered),
            Disposition::Ended(Outcome::Failed),
        ];
        let dones = dispositions.into_iter().map(|disposition| Some((7, disposition))).chain([None]);
        for done in dones {
            for taken in [None, Some(8)] {
                let progress = Progress { done, taken };
                assert_eq!(Progress::read(&progress.frame(Tid::NONE)), Some(progress));
            }
        }
    }

    #[test]
    fn invalid_turn_is_rejected() {
        let mut message = Progress::default().frame(Tid::NONE);
        message.payload = Bytes::from_static(&[9]);
        assert_eq!(Progress::read(&message), None);
        message.payload = Bytes::new();
        assert_eq!(Progress::read(&message), None);
    }
}
