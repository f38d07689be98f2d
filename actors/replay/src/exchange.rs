//! `sinew play --check`: the order to a program, and its report.
//!
//! The command starts the program with the path of a folder in [`VARIABLE`]. The folder names the command itself
//! ([`CheckOwner`]), so that a variable that was left behind has no effect. The builder of the program's first node
//! that has an application of the recording reads the order there, runs its applications in virtual time, writes the
//! report, and ends the process. These files are MessagePack. So a node needs no code for recordings.

use std::{
    collections::{BTreeMap, BTreeSet},
    fs::{File, OpenOptions},
    io::{self, Read as _, Write as _},
    os::unix::fs::OpenOptionsExt as _,
    path::Path,
    time::Duration,
};

use bytes::Bytes;
use serde::{Deserialize, Serialize, de::DeserializeOwned};
use serde_bytes::ByteBuf;
use sinew_runtime::{
    app::DynApp,
    tid::Tid,
    time::Time,
    wire::{Class, Flags, Kind},
};
use sinew_schema::Schema;

use crate::{CheckError, Checked, Comparison, FirstDifference, Replay, TimedMessage};

/// The environment variable with the path of the folder.
pub const VARIABLE: &str = "SINEW_PLAY_CHECK";
/// The command that runs the check, in the folder.
pub const OWNER: &str = "owner";
/// Maximum bytes of the file with it.
pub const OWNER_BYTES_MAX: u64 = 256;
/// The order, in the folder.
pub const ORDER: &str = "order";
/// The report, in the folder.
pub const REPORT: &str = "report";
/// The lines of builders without an application of the recording, in the folder.
pub const DECLARED: &str = "declared";
/// Maximum bytes of the order: its reader has all of it in memory.
pub const ORDER_BYTES_MAX: u64 = 2 << 30;
/// Maximum bytes of the report.
pub const REPORT_BYTES_MAX: u64 = 16 << 20;

/// A recording may end between a message and the answer to it. So messages that arrived in this time before its end, in
/// nanoseconds, are no inputs if no application under test sent anything after them.
const END_NS: u64 = 100_000_000;

/// Each flag, at the place of its bit in a recording.
const FLAGS: [Flags; 6] =
    [Flags::CONFIRM, Flags::ASK, Flags::REPLY, Flags::OUTCOME, Flags::KEEP, Flags::RETAINED];

/// The command that runs the check. Only processes that it has started run it, and only in its time.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct CheckOwner {
    /// Its process.
    pub process: u32,
    /// The begin of the check, in nanoseconds of the host's monotonic clock.
    pub from_ns: u64,
    /// The end of the check, on the same clock: the command then ends the program.
    pub until_ns: u64,
}

/// The order: a recording, and the terms of its comparison.
#[derive(Clone, Debug, Default, Serialize, Deserialize)]
pub struct CheckOrder {
    /// The names of the applications under test. Empty: all of the program that the recording has.
    pub apps: Vec<String>,
    /// The addresses of the names in the recording.
    pub names: BTreeMap<String, u64>,
    /// The messages, in the order of their times.
    pub messages: Vec<RecordedMessage>,
    /// The structures of their types, where the recording has them.
    pub types: Vec<(Kind, Schema)>,
    /// Fields that are not compared.
    pub ignored: Vec<String>,
    /// The time from the start of the applications to the first message from or to one of them, in nanoseconds.
    pub starts_before_ns: u64,
    /// The type by which the applications record their turns.
    #[serde(default)]
    pub turns: Option<Kind>,
}

/// A message of a recording. Times are in nanoseconds of one clock.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecordedMessage {
    /// The sender.
    pub source: u64,
    /// The destination.
    pub destination: u64,
    /// The type.
    pub kind: Kind,
    /// The class.
    pub class: Class,
    /// The flags; bit 0 is [`Flags::CONFIRM`].
    pub flags: u8,
    /// The sequence number of the source.
    pub sequence: u64,
    /// Connects a reply or an outcome to its message.
    pub correlation: u64,
    /// When it was sent.
    pub sent_ns: u64,
    /// How wrong `sent_ns` may be; `u64::MAX`: by any span.
    pub sent_error_ns: u64,
    /// When it was handed over.
    pub arrived_ns: u64,
    /// Microseconds after which it expires; 0: never.
    pub time_to_live_us: u32,
    /// Whether its receiver has rejected it, so that it did not arrive.
    pub is_refused: bool,
    /// The payload, as it was sent.
    pub payload: ByteBuf,
}

/// The report of a program.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum CheckReport {
    /// All messages are those of the recording.
    Identical {
        /// The messages that were compared.
        messages: u64,
        /// The applications that sent them.
        sources: u64,
        /// Recorded messages that an application could not decode, in words.
        misfits: Vec<String>,
    },
    /// A message differs.
    Differs(Box<ReportedDifference>),
    /// The replay did not reach its end, or cannot begin.
    Failed(String),
}

/// The first difference.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct ReportedDifference {
    /// The sender.
    pub source: u64,
    /// The number of the message among those of its source, from 1.
    pub number: u64,
    /// The time, in nanoseconds of the recording's clock.
    pub at_ns: u64,
    /// The type.
    pub type_name: String,
    /// The destination.
    pub destination: u64,
    /// The field and both values, in words.
    pub difference: String,
    /// Recorded messages that an application could not decode, in words.
    pub misfit: Option<String>,
}

impl RecordedMessage {
    /// Returns the message as one of a replay, at the time at which it arrived.
    #[must_use]
    pub fn arrived(&self) -> TimedMessage {
        self.at(Time::from_nanos(self.arrived_ns))
    }

    /// Returns the message as one of a replay, at the time at which it was sent.
    #[must_use]
    pub fn sent(&self) -> TimedMessage {
        self.at(Time::from_nanos(self.sent_ns))
    }

    fn at(&self, at: Time) -> TimedMessage {
        let is_known = self.sent_error_ns != u64::MAX;
        let flags = (0_u8..).zip(FLAGS).filter(|(bit, _)| self.flags & (1 << bit) != 0);
        TimedMessage {
            at,
            source: Tid::from_bits(self.source),
            destination: Tid::from_bits(self.destination),
            kind: self.kind,
            class: self.class,
            flags: flags.fold(Flags::NONE, |all, (_, flag)| all.with(flag)),
            payload: Bytes::copy_from_slice(&self.payload),
            correlation: self.correlation,
            sequence: self.sequence,
            sent: Time::from_nanos(self.sent_ns),
            sent_error: is_known.then(|| Duration::from_nanos(self.sent_error_ns)),
            time_to_live_us: self.time_to_live_us,
        }
    }

    fn has(&self, flag: Flags) -> bool {
        (0_u8..).zip(FLAGS).any(|(bit, known)| known == flag && self.flags & (1 << bit) != 0)
    }
}

impl CheckOrder {
    /// Returns whether this application is under test.
    #[must_use]
    pub fn tests(&self, app: &str) -> bool {
        self.names.contains_key(app) && (self.apps.is_empty() || self.apps.iter().any(|name| name == app))
    }

    /// Returns the messages for a check of these applications: those that they sent, at the times at which they did,
    /// and those that arrived at them or at a group.
    #[must_use]
    pub fn messages_of(&self, tested: &BTreeSet<Tid>) -> Vec<TimedMessage> {
        let (mut expected, mut inputs) = (Vec::new(), Vec::new());
        for message in &self.messages {
            let (source, destination) = (Tid::from_bits(message.source), Tid::from_bits(message.destination));
            if tested.contains(&source) {
                // A node reports outcomes, not an application. A group's member that rejects has a record of its own.
                let is_copy = message.is_refused && !destination.is_single();
                if !message.has(Flags::OUTCOME) && !is_copy {
                    expected.push(message.sent());
                }
            } else if !message.is_refused && (tested.contains(&destination) || !destination.is_single()) {
                inputs.push(message.arrived());
            }
        }
        let last = expected.iter().map(|message| message.at).max().unwrap_or(Time::ZERO);
        let end_ns = self.messages.iter().map(|message| message.arrived_ns).max().unwrap_or(0);
        inputs.retain(|input| input.at <= last || input.at.as_nanos().saturating_add(END_NS) <= end_ns);
        expected.append(&mut inputs);
        // Stable: messages of one time and one sort keep the order of the recording.
        expected.sort_by_key(|message| message.at);
        expected
    }

    /// Returns when the applications start; `None`: with the first message. Where the start is stated, messages to
    /// groups before it are removed: they did not arrive at these applications, and would begin the grids of their
    /// timers too early.
    fn start(&self, tested: &BTreeSet<Tid>, messages: &mut Vec<TimedMessage>) -> Option<Time> {
        if self.starts_before_ns == 0 {
            return None;
        }
        let is_own = |message: &&TimedMessage| {
            tested.contains(&message.source) || tested.contains(&message.destination)
        };
        let first = messages.iter().find(is_own)?.at;
        let start = Time::from_nanos(first.as_nanos().saturating_sub(self.starts_before_ns));
        messages.retain(|message| message.at >= start);
        Some(start)
    }

    /// Runs the applications under test, and compares. Ignores all others.
    ///
    /// # Errors
    /// The replay did not reach its end, or differs from the recording.
    pub fn check(&self, apps: Vec<DynApp>) -> Result<Checked, CheckError> {
        let mut replay = Replay::new();
        let mut tested = BTreeSet::new();
        for (name, tid) in &self.names {
            replay = replay.name(name, Tid::from_bits(*tid));
        }
        for app in apps {
            if let Some(tid) = self.names.get(app.name()).filter(|_| self.tests(app.name())) {
                tested.insert(Tid::from_bits(*tid));
                replay = replay.app(app);
            }
        }
        let mut messages = self.messages_of(&tested);
        // An output may be the first message: without a start the first input would be it.
        let start = self.start(&tested, &mut messages).or_else(|| Some(messages.first()?.at));
        if let Some(start) = start {
            replay = replay.starts_at(start);
        }
        if let Some(kind) = self.turns {
            replay = replay.turns(kind);
        }
        for (kind, schema) in &self.types {
            replay = replay.recorded_type(*kind, schema.clone());
        }
        let comparison =
            self.ignored.iter().fold(Comparison::default(), |all, field| all.ignoring(field.as_str()));
        replay.check_by(&comparison, messages)
    }

    /// Same as [`check`](Self::check), with the result as a report.
    #[must_use]
    pub fn run(&self, apps: Vec<DynApp>) -> CheckReport {
        match self.check(apps) {
            Ok(Checked { messages: 0, .. }) => CheckReport::Failed(
                "the recording has no message to compare: none that an application under test sent, or none of the type of its turns"
                    .to_owned(),
            ),
            Ok(checked) => CheckReport::Identical {
                messages: checked.messages as u64,
                sources: checked.sources as u64,
                misfits: checked.misfits.iter().map(ToString::to_string).collect(),
            },
            Err(CheckError::Replay(error)) => CheckReport::Failed(error.to_string()),
            Err(CheckError::Differs(difference)) => CheckReport::of(&difference, None),
            Err(CheckError::Misfit(misfit, difference)) => {
                CheckReport::of(&difference, Some(misfit.to_string()))
            }
        }
    }
}

impl CheckReport {
    fn of(difference: &FirstDifference, misfit: Option<String>) -> Self {
        let kind = difference.kind;
        Self::Differs(Box::new(ReportedDifference {
            source: difference.sender.bits(),
            number: difference.number as u64,
            at_ns: difference.at.as_nanos(),
            type_name: kind.type_name().map_or_else(|| kind.to_string(), str::to_owned),
            destination: difference.destination.bits(),
            difference: difference.what.clone(),
            misfit,
        }))
    }
}

/// Writes a value to a new file that only this user may read.
///
/// # Errors
/// The file exists, or cannot be written.
pub fn write<T: Serialize>(path: &Path, value: &T) -> io::Result<()> {
    let file = OpenOptions::new().write(true).create_new(true).mode(0o600).open(path)?;
    let mut file = io::BufWriter::new(file);
    rmp_serde::encode::write_named(&mut file, value).map_err(io::Error::other)?;
    file.flush()
}

/// Reads a value from a file of at most `bytes_max` bytes.
///
/// # Errors
/// The file cannot be read, is too long, or has another content.
pub fn read<T: DeserializeOwned>(path: &Path, bytes_max: u64) -> io::Result<T> {
    let mut bytes = Vec::new();
    File::open(path)?.take(bytes_max.saturating_add(1)).read_to_end(&mut bytes)?;
    if bytes.len() as u64 > bytes_max {
        return Err(io::Error::new(
            io::ErrorKind::InvalidData,
            format!("it is longer than {bytes_max} bytes"),
        ));
    }
    rmp_serde::from_slice(&bytes).map_err(|why| io::Error::new(io::ErrorKind::InvalidData, why))
}

#[cfg(test)]
mod tests {
    use super::*;

    fn message(flags: u8) -> RecordedMessage {
        RecordedMessage {
            source: Tid::from_bits(0x0a00_0001_0000_1001).bits(),
            destination: Tid::from_bits(0x0a00_0001_0000_1002).bits(),
            kind: Kind::named("demo.angle"),
            class: Class::Stream,
            flags,
            sequence: 7,
            correlation: 3,
            sent_ns: 5,
            sent_error_ns: u64::MAX,
            arrived_ns: 9,
            time_to_live_us: 20,
            is_refused: false,
            payload: ByteBuf::from(b"\x81\xa1x\x05".to_vec()),
        }
    }

    #[test]
    fn order_is_read_as_it_was_written() {
        let folder = std::env::temp_dir().join(format!("sinew-exchange-{}", std::process::id()));
        std::fs::create_dir_all(&folder).unwrap();
        let path = folder.join(ORDER);
        let _ = std::fs::remove_file(&path);
        let order = CheckOrder {
            names: BTreeMap::from([("knee".to_owned(), 5)]),
            messages: vec![message(1), message(4)],
            ..CheckOrder::default()
        };
        write(&path, &order).unwrap();
        assert!(write(&path, &order).is_err(), "no file is replaced");
        let read_again: CheckOrder = read(&path, ORDER_BYTES_MAX).unwrap();
        assert_eq!((&read_again.messages, &read_again.names), (&order.messages, &order.names));
        assert!(read::<CheckOrder>(&path, 8).unwrap_err().to_string().contains("longer than 8 bytes"));
        assert!(read::<CheckReport>(&path, ORDER_BYTES_MAX).is_err());
        std::fs::remove_dir_all(&folder).unwrap();
    }

    #[test]
    fn times_and_flags_become_those_of_a_replay() {
        let confirmed_reply = message(0b0101);
        let arrived = confirmed_reply.arrived();
        assert_eq!((arrived.at, arrived.sent), (Time::from_nanos(9), Time::from_nanos(5)));
        assert_eq!(arrived.flags, Flags::CONFIRM.with(Flags::REPLY));
        assert_eq!((arrived.sent_error, arrived.time_to_live_us), (None, 20));
        assert_eq!(confirmed_reply.sent().at, Time::from_nanos(5));
    }

    #[test]
    fn rejected_and_foreign_messages_are_no_inputs() {
        let (tested, other) = (message(0), message(0));
        let own = Tid::from_bits(tested.source);
        let input = RecordedMessage { source: other.destination, destination: other.source, ..other.clone() };
        let refused = RecordedMessage { is_refused: true, ..input.clone() };
        let foreign = RecordedMessage { destination: 0x0a00_0001_0000_1009, ..input.clone() };
        let outcome = message(0b1000);
        let later = RecordedMessage { arrived_ns: 9 + END_NS, ..foreign.clone() };
        let messages = vec![tested, input, refused, foreign, outcome, later];
        let order = CheckOrder { messages, ..CheckOrder::default() };
        let chosen = order.messages_of(&BTreeSet::from([own]));
        let sources: Vec<_> = chosen.iter().map(|message| message.source.bits()).collect();
        assert_eq!(sources, [own.bits(), message(0).destination]);
        // And: without the later message its input is at the end of the recording
        let messages = order.messages[..5].to_vec();
        let order = CheckOrder { messages, ..CheckOrder::default() };
        assert_eq!(order.messages_of(&BTreeSet::from([own])).len(), 1);
    }
    #[test]
    fn stated_start_counts_from_the_first_application_message() {
        let own = Tid::from_bits(message(0).source);
        let at = |arrived_ns, destination: Tid| RecordedMessage {
            source: message(0).destination,
            destination: destination.bits(),
            arrived_ns,
            ..message(0)
        };
        let group = Tid::group("demo.status");
        let messages = vec![at(100, group), at(450, group), at(500, own), at(END_NS, group)];
        let starts = |starts_before_ns| {
            let order = CheckOrder { messages: messages.clone(), starts_before_ns, ..CheckOrder::default() };
            let (tested, mut chosen) = (BTreeSet::from([own]), Vec::new());
            chosen.extend(messages.iter().map(RecordedMessage::arrived));
            (order.start(&tested, &mut chosen), chosen.len())
        };
        assert_eq!(starts(60), (Some(Time::from_nanos(440)), 3));
        assert_eq!(starts(0), (None, 4), "all messages to groups may be inputs");
    }
}
