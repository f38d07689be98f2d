//! The terms of a recording: its origin, its channels and their messages.

use std::{fmt, time::Duration};

use sinew_schema::Schema;

/// The compression of a recording's chunks.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Compression {
    /// None: the least work, the largest files.
    None,
    /// LZ4: little work.
    Lz4,
    /// Zstandard: the smallest files.
    #[default]
    Zstd,
}

/// How a recording is written.
///
/// # Examples
///
/// ```
/// use sinew_bag::Options;
///
/// let options = Options { size_max: Some(10 << 30), ..Options::default() };
/// assert_eq!(options.chunk_bytes, 1 << 20);
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Options {
    /// The compression of chunks.
    pub compression: Compression,
    /// Bytes of a chunk before it is compressed. Default: 1 MiB. A chunk is also written when it is a second old.
    pub chunk_bytes: u64,
    /// Maximum bytes of all parts. From then on every message is counted as dropped.
    pub size_max: Option<u64>,
    /// Bytes of a file, after which the next part begins.
    pub split_bytes: Option<u64>,
    /// Time span of a file, after which the next part begins.
    pub split_time: Option<Duration>,
    /// Whether views are left out. Each message has a header in their place: sequence, correlation, age.
    pub raw_only: bool,
    /// Whether an existing file of that name is replaced.
    pub replace: bool,
}

impl Default for Options {
    fn default() -> Self {
        Self {
            compression: Compression::default(),
            chunk_bytes: 1 << 20,
            size_max: None,
            split_bytes: None,
            split_time: None,
            raw_only: false,
            replace: false,
        }
    }
}

/// The node that records, and its clock.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Origin {
    /// The name of the node.
    pub node: String,
    /// The address of the node, as in its TIDs.
    pub address: String,
    /// The incarnation of the node.
    pub incarnation: u64,
    /// The program and its version.
    pub version: String,
    /// Wall clock minus monotonic clock, in nanoseconds, read once. All times of the file are the monotonic clock plus
    /// this offset, so no step of the wall clock is in them.
    pub wall_offset_ns: i64,
    /// The monotonic time at which the recording began, in nanoseconds.
    pub began_ns: u64,
}

impl Origin {
    /// Returns a monotonic time as nanoseconds of the file's wall clock.
    #[must_use]
    pub fn wall_ns(&self, monotonic_ns: u64) -> u64 {
        monotonic_ns.saturating_add_signed(self.wall_offset_ns)
    }
}

/// A source or a destination.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct Party {
    /// The TID as a number.
    pub tid: u64,
    /// The TID as text.
    pub text: String,
    /// The registered name, or that of the group.
    pub name: Option<String>,
    /// The address of its node; `None` for groups and broadcasts.
    pub node: Option<String>,
}

impl Party {
    /// Returns the name for people: the registered one, else the TID.
    #[must_use]
    pub fn label(&self) -> &str {
        self.name.as_deref().unwrap_or(&self.text)
    }
}

/// Whether the recording node sent the messages of a channel, or received them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Direction {
    /// An application of this node sent them.
    #[default]
    Sent,
    /// They came from another node.
    Received,
}

/// The class of a channel's messages.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Class {
    /// Ordered, before all others.
    #[default]
    Control,
    /// The newest value replaces older ones.
    Stream,
    /// Ordered, behind all others.
    Bulk,
}

/// The text of a value in metadata, and its way back.
macro_rules! texts {
    ($type:ident: $($variant:ident = $text:literal),+) => {
        impl fmt::Display for $type {
            fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
                f.write_str(match self { $(Self::$variant => $text),+ })
            }
        }

        impl $type {
            pub(crate) fn from_text(text: &str) -> Option<Self> {
                match text { $($text => Some(Self::$variant),)+ _ => None }
            }
        }
    };
}

texts!(Direction: Sent = "sent", Received = "received");
texts!(Class: Control = "Control", Stream = "Stream", Bulk = "Bulk");

/// A channel: the messages of one type from one source to one destination, of one class and one direction.
#[derive(Clone, Copy, Debug)]
pub struct ChannelInfo<'i> {
    /// The sender.
    pub source: &'i Party,
    /// The destination.
    pub destination: &'i Party,
    /// The name of the payload type, such as `exo.angle`.
    pub type_name: &'i str,
    /// The number of the payload type.
    pub kind: u32,
    /// The class.
    pub class: Class,
    /// Whether this node sent the messages.
    pub direction: Direction,
    /// Whether the payloads have envelopes of protection.
    pub is_protected: bool,
    /// The structure of the payload, where it is known.
    pub schema: Option<&'i Schema>,
    /// The reason, where the channel has messages that were rejected.
    pub refused: Option<&'i str>,
    /// The messages that the channel had before this recording began.
    pub seen_before: u64,
}

/// The number of a channel in its [`BagWriter`](crate::BagWriter).
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub struct ChannelId(pub(crate) u32);

/// A message. Times are of the node's monotonic clock.
#[derive(Clone, Copy, Debug, Default)]
pub struct Record<'p> {
    /// Its number in the channel, from 1: each message that was seen has one.
    pub number: u64,
    /// The sequence number of the source.
    pub sequence: u64,
    /// Connects a reply or an outcome to its message; 0 without one.
    pub correlation: u64,
    /// The flags of the header.
    pub flags: u8,
    /// When it was sent, in nanoseconds.
    pub sent_ns: u64,
    /// How wrong `sent_ns` may be, in nanoseconds.
    pub sent_error_ns: u64,
    /// When it was handed over, in nanoseconds.
    pub handed_over_ns: u64,
    /// Microseconds after `sent_ns` at which it expires; 0: never.
    pub time_to_live_us: u32,
    /// The payload, as it was sent.
    pub payload: &'p [u8],
    /// The value inside the envelope of a protected payload, for the view. `None`: the payload is the value.
    pub inner: Option<&'p [u8]>,
}

impl<'p> Record<'p> {
    /// Returns the bytes of the value that the view shows.
    pub(crate) fn value(&self) -> &'p [u8] {
        self.inner.unwrap_or(self.payload)
    }
}

/// The clock of another node, as this node measured it.
#[derive(Clone, Debug, Default, PartialEq)]
pub struct ClockReading {
    /// The address of the other node.
    pub peer: String,
    /// The name of the other node.
    pub name: Option<String>,
    /// The incarnation of the other node.
    pub incarnation: u64,
    /// Monotonic clock of the other node minus that of this node, in nanoseconds.
    pub offset_ns: i64,
    /// How wrong `offset_ns` may be, in nanoseconds.
    pub bound_ns: u64,
    /// How fast the other clock gains on this one, in parts per billion.
    pub drift_ppb: i64,
    /// How wrong `drift_ppb` may be, in parts per billion. 200,000 with a drift of 0: the drift is unknown.
    pub drift_bound_ppb: u64,
}

/// The topic of an event.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum EventTopic {
    /// `/sinew/events`: nodes, restarts, safe states, triggers.
    Events,
    /// `/sinew/barriers`
    Barriers,
    /// `/sinew/outcomes`
    Outcomes,
    /// `/sinew/log`
    Log,
}

impl EventTopic {
    /// Every topic.
    pub const ALL: [Self; 4] = [Self::Events, Self::Barriers, Self::Outcomes, Self::Log];

    /// Returns its topic in the file.
    #[must_use]
    pub const fn topic(self) -> &'static str {
        match self {
            Self::Events => "/sinew/events",
            Self::Barriers => "/sinew/barriers",
            Self::Outcomes => "/sinew/outcomes",
            Self::Log => "/sinew/log",
        }
    }
}

/// The level of an event.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord, Hash)]
pub enum Level {
    /// For developers.
    Debug,
    /// As intended.
    Info,
    /// A fault that was handled.
    Warning,
    /// A fault.
    Error,
}

impl Level {
    /// Returns its number in the schema `foxglove.Log`.
    pub(crate) const fn number(self) -> u8 {
        match self {
            Self::Debug => 1,
            Self::Info => 2,
            Self::Warning => 3,
            Self::Error => 4,
        }
    }
}

/// An event of the node.
#[derive(Clone, Copy, Debug)]
pub struct Event<'e> {
    /// Its topic.
    pub topic: EventTopic,
    /// When it was, in nanoseconds of the monotonic clock.
    pub at_ns: u64,
    /// Its level.
    pub level: Level,
    /// Its origin, such as a node, an application or a module.
    pub name: &'e str,
    /// One line for people.
    pub text: &'e str,
    /// The same for programs; `null` without it.
    pub data: &'e serde_json::Value,
}

/// The counters of a recording.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Totals {
    /// Messages that the node had on the recorded channels.
    pub seen: u64,
    /// Messages in the files.
    pub written: u64,
    /// Messages that are in no file.
    pub dropped: u64,
    /// Messages with a payload that does not fit its schema. They are written without a view.
    pub misfits: u64,
    /// Events, outcomes and clock readings that are in no file.
    pub events_lost: u64,
    /// Bytes of all parts.
    pub bytes: u64,
    /// Files.
    pub parts: u32,
}
