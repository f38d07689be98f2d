//! A message with the time at which it was sent or arrived: the input and the output of a replay.

use std::time::Duration;

use bytes::Bytes;
use sinew_runtime::{
    outcome::{Outcome, Ticket},
    tid::Tid,
    time::Time,
    wire::{Class, Flags, Header, Kind, Message, Payload},
};

/// A message at a point in virtual time.
///
/// For an input `at` is the time of its arrival, for an output the time at which it was sent. A recording has
/// the header and the payload of each message: [`new`](Self::new). A test has a value: [`of`](Self::of).
///
/// # Examples
///
/// ```
/// use sinew::{prelude::*, replay::TimedMessage};
///
/// payload!("demo.angle", Stream => struct Angle { degrees: f32 });
///
/// let (hip, knee): (Tid, Tid) = ("10.0.0.1/1001".parse()?, "10.0.0.2/1001".parse()?);
/// let arrived = Time::from_nanos(1_005_000_000);
/// // It was sent 2 ms before it arrives.
/// let angle = TimedMessage::of(arrived, hip, knee, &Angle { degrees: 10.0 });
/// let angle = angle.sent_at(arrived - Duration::from_millis(2));
/// assert_eq!((angle.kind, angle.class), (Angle::KIND, Class::Stream));
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct TimedMessage {
    /// The virtual time.
    pub at: Time,
    /// The sender.
    pub source: Tid,
    /// The destination: an application, a group, or all applications.
    pub destination: Tid,
    /// The type of the payload.
    pub kind: Kind,
    /// The class.
    pub class: Class,
    /// The requests to the receiver, and whether this is a reply or an outcome.
    pub flags: Flags,
    /// The payload as it was sent: MessagePack, or raw bytes.
    pub payload: Bytes,
    /// The number that connects a reply or an outcome to its message; 0 without one.
    pub correlation: u64,
    /// The sequence number of the source; 0 if it is not known.
    pub sequence: u64,
    /// When the message was sent, in the clock of `at`.
    pub sent: Time,
    /// The error of `sent`; `None`: the age of the message is unknown.
    pub sent_error: Option<Duration>,
    /// The age at which the message expires, in microseconds; 0: never.
    pub time_to_live_us: u32,
}

impl TimedMessage {
    /// Creates the message of a recorded header and payload.
    #[must_use]
    pub const fn new(at: Time, header: &Header, payload: Bytes) -> Self {
        Self {
            at,
            source: header.source,
            destination: header.destination,
            kind: header.kind,
            class: header.class,
            flags: header.flags,
            payload,
            correlation: header.correlation,
            sequence: header.sequence,
            sent: header.sent,
            sent_error: header.sent_error(),
            time_to_live_us: header.time_to_live_us,
        }
    }

    /// Creates a message with this value, sent at `at`, with the class and the time to live of its type.
    #[must_use]
    pub fn of<P: Payload>(at: Time, source: Tid, destination: Tid, value: &P) -> Self {
        let message = Message::typed(source, destination, value);
        Self::new(at, &message.header, message.payload).sent_at(at)
    }

    /// Creates the reply of `source` to the request with the number `correlation` of `destination`. If that
    /// has no open request of this number, the oldest one to `source` is answered.
    #[must_use]
    pub fn reply<P: Payload>(at: Time, source: Tid, destination: Tid, correlation: u64, value: &P) -> Self {
        let reply = Self::of(at, source, destination, value);
        Self { class: Class::Control, flags: Flags::REPLY, correlation, ..reply }
    }

    /// Creates the outcome of the confirmed message with the number `correlation` from `destination` to
    /// `source`. If that has no open message of this number, it is the outcome of the oldest one.
    #[must_use]
    pub fn outcome(at: Time, source: Tid, destination: Tid, correlation: u64, outcome: Outcome) -> Self {
        let ticket = Ticket { source: destination, destination: source, correlation };
        let message = Message::outcome(ticket, outcome);
        Self::new(at, &message.header, message.payload).sent_at(at)
    }

    /// Sets when the message was sent, in the clock of `at`.
    #[must_use]
    pub fn sent_at(self, sent: Time) -> Self {
        Self { sent, ..self }
    }

    /// Returns the message as the runtime delivers it.
    pub(crate) fn into_message(self) -> Message {
        let mut header = Header::new(self.kind, self.source, self.destination);
        (header.class, header.flags) = (self.class, self.flags);
        (header.correlation, header.sequence) = (self.correlation, self.sequence);
        (header.sent, header.time_to_live_us) = (self.sent, self.time_to_live_us);
        header.set_sent_error(self.sent_error);
        Message::new(header, self.payload)
    }

    /// Returns whether this answers a message of its destination.
    pub(crate) const fn is_answer(&self) -> bool {
        self.flags.has(Flags::REPLY) || self.flags.has(Flags::OUTCOME)
    }
}
