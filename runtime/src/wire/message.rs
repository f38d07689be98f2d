//! A message in memory: header, payload bytes, and the receipt to settle.

use std::{
    ops::{Deref, DerefMut},
    time::Duration,
};

use bytes::{Bytes, BytesMut};
use serde::{Serialize, de::DeserializeOwned};

use crate::{
    outcome::{MemberReport, Outcome, Receipt, Rejection, Ticket},
    tid::{AppAddress, NodeAddress, Tid},
    wire::{Class, Flags, Header, Kind, MismatchPolicy, Protection, memory, read::decode_payload, remember},
};

/// A type that is sent as MessagePack (a map with field names, so that any language can read it).
///
/// # Examples
///
/// ```
/// use sinew::{Class, Payload, serde::{Deserialize, Serialize}};
///
/// #[derive(Serialize, Deserialize)]
/// #[serde(crate = "sinew::serde")]
/// struct JointAngle { degrees: f32 }
///
/// impl Payload for JointAngle {
///     const NAME: &'static str = "demo.joint_angle";
///     const CLASS: Class = Class::Stream; // a value that a newer one replaces
/// }
/// ```
pub trait Payload: Serialize + DeserializeOwned + Send + 'static {
    /// The name of the type, the same in every program: `project.type`.
    const NAME: &'static str;
    /// The ID of the type on the wire.
    const KIND: Kind = Kind::named(Self::NAME);
    /// The class of this type, unless the sender sets another.
    const CLASS: Class = Class::Control;
    /// The age at which a queued message of this type expires. `None`: never. A time that is set for one
    /// message has precedence:
    /// [`MessageBuilder::expires_after`](crate::sender::MessageBuilder::expires_after).
    const TIME_TO_LIVE: Option<Duration> = None;
    /// The limits of a receiver, for a type with end-to-end protection: see [`protection`](crate::protection).
    const PROTECTION: Option<Protection> = None;
    /// Whether the node retains the latest value that an application has sent to a group, and hands it over to a
    /// member that joins later ([`Delivery::is_retained`](crate::app::Delivery::is_retained)). It is removed at the end
    /// of its time to live and of its sender, and by
    /// [`Sender::clear_retained`](crate::sender::Sender::clear_retained). Such a type is not of class Stream and has no
    /// `PROTECTION`, or it does not compile where it is sent. It is always sent to a group in its own class. A message
    /// to the members on one node alone is not retained, and leaves the retained value as it is.
    const RETAINED: bool = false;
    /// The treatment of messages from a sender with another version of this type, on another node or in another
    /// process. The receiver's type decides.
    const MISMATCH: MismatchPolicy = MismatchPolicy::AcceptAdditions;
}

/// The reason why a payload could not be decoded. This is an error of the peer: its type of this name differs.
#[derive(Debug, thiserror::Error)]
#[error("this is not a {name}: {cause}")]
pub struct DecodeError {
    name: &'static str,
    cause: rmp_serde::decode::Error,
}

impl DecodeError {
    /// Returns the error for a protected `P` that was received without a guard.
    #[must_use]
    pub fn unguarded<P: Payload>() -> Self {
        let words = "it is protected, and did not come through a guard; make one for its sender".to_owned();
        Self { name: P::NAME, cause: rmp_serde::decode::Error::Syntax(words) }
    }
}

/// A message, sent or to be sent.
///
/// It has 128 bytes on 64-bit systems. Up to this length x86-64 compilers copy a value in place: a move from
/// function to function costs half as much as a call of `memcpy`. A message is moved some thirty times.
#[derive(Debug)]
pub struct Message {
    /// Source, destination, type and times of the message.
    pub header: Header,
    /// The payload, shared without a copy within a process.
    pub payload: Bytes,
    /// The receipt for its outcome; `None` for an unconfirmed message.
    pub receipt: Option<Receipt>,
}

impl Message {
    /// Creates an unconfirmed message.
    #[must_use]
    pub const fn new(header: Header, payload: Bytes) -> Self {
        Self { header, payload, receipt: None }
    }

    /// Creates the message that carries the outcome of the message of `ticket` to its sender. Allocates no memory.
    #[must_use]
    pub fn outcome(ticket: Ticket, outcome: Outcome) -> Self {
        let mut header = Header::new(Kind::OUTCOME, ticket.destination, ticket.source);
        header.flags = Flags::OUTCOME;
        header.correlation = ticket.correlation;
        Self::new(header, code_of(outcome))
    }

    /// Creates the reports about the members of the message to many of `ticket`, in frames with payloads of
    /// at most `payload_max` bytes, or one report. spec: FRAME-7
    pub fn members(
        ticket: Ticket,
        reports: &[MemberReport],
        payload_max: usize,
    ) -> impl Iterator<Item = Self> {
        reports.chunks(MemberReport::in_payload(payload_max)).map(move |reports| {
            let mut header = Header::new(Kind::MEMBERS, ticket.destination, ticket.source);
            header.flags = Flags::OUTCOME;
            header.correlation = ticket.correlation;
            Self::new(header, MemberReport::encode(reports).into())
        })
    }

    /// Creates the message that cancels the request of `ticket` at its receiver.
    #[must_use]
    pub const fn cancel(ticket: Ticket) -> Self {
        let mut header = Header::new(Kind::CANCEL, ticket.source, ticket.destination);
        header.correlation = ticket.correlation;
        Self::new(header, Bytes::new())
    }

    /// Creates a message of the given type, in its own class. A type that is [protected](crate::protection)
    /// does not compile here: its messages are created by the context, or the
    /// [`Sender`](crate::sender::Sender), of an application.
    ///
    /// # Panics
    /// If the type's `Serialize` fails for its own value (for example a map with two equal keys): an error of
    /// the program.
    #[must_use]
    pub fn typed<P: Payload>(source: Tid, destination: Tid, value: &P) -> Self {
        const { assert!(P::PROTECTION.is_none(), "a protected payload is sent by the context of an application") };
        Self::of_type::<P>(source, destination, encode(value))
    }

    /// Same as [`typed`](Self::typed), for the encoded bytes of a `P`.
    pub(crate) fn of_type<P: Payload>(source: Tid, destination: Tid, payload: Bytes) -> Self {
        let _ = remember::<P>();
        Self::of_remembered::<P>(source, destination, payload)
    }

    /// Same as [`of_type`](Self::of_type), for a type that the caller has recorded.
    pub(crate) fn of_remembered<P: Payload>(source: Tid, destination: Tid, payload: Bytes) -> Self {
        const {
            assert!(
                !P::RETAINED || P::PROTECTION.is_none(),
                "a protected payload is not retained: it would be old"
            );
            assert!(
                !P::RETAINED || !matches!(P::CLASS, Class::Stream),
                "a retained payload is of class Control or Bulk: a newer value of class Stream comes soon anyway"
            );
        }
        let mut header = Header::new(P::KIND, source, destination);
        header.class = P::CLASS;
        // The members of one node alone are not the group, of which this is the last value.
        if P::RETAINED && destination.node == NodeAddress::ALL && destination.app.is_group() {
            header.flags = Flags::KEEP;
        }
        if let Some(time) = P::TIME_TO_LIVE {
            // No wait depends on it here.
            let _ = header.set_time_to_live(time);
        }
        Self::new(header, payload)
    }

    /// Creates the message that removes the retained value of this type from a group. spec: FRAME-8.3
    #[must_use]
    pub fn clear_retained<P: Payload>(source: Tid, group: AppAddress) -> Self {
        const { assert!(P::RETAINED, "only a payload with `RETAINED` has a retained value") };
        let destination = Tid::new(NodeAddress::ALL, group);
        let mut message = Self::of_remembered::<P>(source, destination, Bytes::new());
        message.header.time_to_live_us = 0;
        message
    }

    /// Decodes the payload as a `P`.
    ///
    /// # Errors
    /// The bytes are not a `P`.
    pub fn decode<P: Payload>(&self) -> Result<P, DecodeError> {
        decode_as(&self.payload)
    }

    /// Settles the message with its outcome, if it is confirmed.
    pub fn settle(&mut self, outcome: Outcome) {
        if let Some(receipt) = self.receipt.take() {
            receipt.settle(outcome);
        }
    }

    /// Rejects this message.
    pub fn reject(mut self, why: Rejection) {
        self.settle(Outcome::Rejected(why));
    }

    /// Returns the ticket that identifies this message in an outcome.
    #[must_use]
    pub const fn ticket(&self) -> Ticket {
        let Header { source, destination, correlation, .. } = self.header;
        Ticket { source, destination, correlation }
    }

    /// Returns whether this is the request of `ticket`.
    #[must_use]
    pub fn is_request(&self, ticket: Ticket) -> bool {
        self.header.flags.has(Flags::ASK) && self.ticket() == ticket
    }

    /// Returns the bytes that this message occupies in a queue: its header and its payload.
    #[must_use]
    pub fn size(&self) -> usize {
        super::HEADER_LEN + self.payload.len()
    }
}

/// Returns the payload of an OUTCOME, without an allocation.
fn code_of(outcome: Outcome) -> Bytes {
    static CODES: [u8; 256] = {
        let mut codes = [0; 256];
        let mut code = 0;
        while code < codes.len() {
            codes[code] = code as u8;
            code += 1;
        }
        codes
    };
    let at = usize::from(outcome.code());
    Bytes::from_static(&CODES[at..=at])
}

/// Encodes `value` as MessagePack.
///
/// # Panics
/// If the type's `Serialize` fails for its own value: an error of the program, found at its first send.
pub fn encode<T: Serialize>(value: &T) -> Bytes {
    memory::written(|writer| rmp_serde::encode::write_named(writer, value))
        .expect("a payload type can be written as MessagePack")
}

/// Decodes a value from the bytes of a payload that is a `P`.
pub(crate) fn decode_as<P: Payload>(bytes: &[u8]) -> Result<P, DecodeError> {
    let read = decode_payload(bytes).or_else(|cause| without_fields(bytes).ok_or(cause));
    read.map_err(|cause| DecodeError { name: P::NAME, cause })
}

/// MessagePack forms of a value without fields: an empty map, an empty array, nil.
const NO_FIELDS: [&[u8]; 3] = [&[0x80], &[0x90], &[0xc0]];

/// Decodes a type without fields (`struct Stop;`, `struct Stop {}`), from any form of an empty value, also no
/// bytes at all.
fn without_fields<T: DeserializeOwned + Serialize>(bytes: &[u8]) -> Option<T> {
    // A type of size zero has no fields with values: no value is read that the sender has not written.
    let is_one = size_of::<T>() == 0 && (bytes.is_empty() || NO_FIELDS.contains(&bytes));
    NO_FIELDS.into_iter().filter(|_| is_one).find_map(|form| decode_payload(form).ok())
}

/// Writable memory for a raw payload, from `create_message`.
///
/// # Examples
///
/// ```
/// use sinew::{Tid, message::{Kind, SendError, Sender}};
///
/// /// Sends raw samples that are written where they travel from.
/// fn record(sender: &Sender, recorder: Tid, samples: &[f32]) -> Result<(), SendError> {
///     let mut memory = sender.create_message(recorder, Kind::named("plate.samples"), 4 * samples.len())?;
///     for (bytes, sample) in memory.chunks_exact_mut(4).zip(samples) {
///         bytes.copy_from_slice(&sample.to_le_bytes());
///     }
///     sender.loaned(memory).send()
/// }
/// ```
#[derive(Debug)]
pub struct MessageBuffer {
    header: Header,
    payload: BytesMut,
}

impl MessageBuffer {
    /// Creates zeroed memory for `length` payload bytes.
    #[must_use]
    pub fn new(header: Header, length: usize) -> Self {
        Self { header, payload: memory::zeroed(length) }
    }

    /// Returns the message; its payload is no longer writable.
    #[must_use]
    pub fn freeze(self) -> Message {
        Message::new(self.header, self.payload.freeze())
    }

    /// Sets the class of the message.
    pub fn set_class(&mut self, class: Class) {
        self.header.class = class;
    }
}

impl Deref for MessageBuffer {
    type Target = [u8];

    fn deref(&self) -> &[u8] {
        &self.payload
    }
}

impl DerefMut for MessageBuffer {
    fn deref_mut(&mut self) -> &mut [u8] {
        &mut self.payload
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Debug, Serialize, serde::Deserialize)]
    struct Point {
        x: f64,
    }

    impl Payload for Point {
        const NAME: &'static str = "test.point";
    }

    #[test]
    #[cfg(target_pointer_width = "64")]
    fn message_is_short_enough_to_be_moved_in_place() {
        assert_eq!(size_of::<Message>(), 128);
    }

    #[derive(Debug, Serialize, serde::Deserialize)]
    struct Mode(u8);

    impl Payload for Mode {
        const NAME: &'static str = "test.retained_mode";
        const CLASS: Class = Class::Bulk;
        const TIME_TO_LIVE: Option<Duration> = Some(Duration::from_secs(1));
        const RETAINED: bool = true;
    }

    #[test]
    fn retained_type_is_kept_in_its_class_and_groups() {
        let group = Tid::group("modes");
        let mut to_group = Message::typed(Tid::NONE, group, &Mode(1)).header;
        let mut to_one = Message::typed(Tid::NONE, Tid::from_bits(0x1_0000_1000), &Mode(1)).header;
        assert_eq!((to_group.flags, to_one.flags), (Flags::KEEP, Flags::NONE));
        assert_eq!(Message::typed(Tid::NONE, group, &Point { x: 1.0 }).header.flags, Flags::NONE);
        for node in [NodeAddress::HERE, NodeAddress::new(0x0a00_0001)] {
            let of_one_node = Tid::new(node, group.app);
            assert_eq!(Message::typed(Tid::NONE, of_one_node, &Mode(1)).header.flags, Flags::NONE);
        }
        to_group.override_class(Class::Control);
        to_one.override_class(Class::Control);
        assert_eq!((to_group.class, to_one.class), (Class::Bulk, Class::Control));
    }

    #[test]
    fn removal_of_retained_value_is_empty_without_expiry() {
        let Message { header, payload, .. } =
            Message::clear_retained::<Mode>(Tid::NONE, AppAddress::group("modes"));
        assert_eq!((header.destination, header.flags), (Tid::group("modes"), Flags::KEEP));
        assert_eq!((header.kind, header.class), (Mode::KIND, Class::Bulk));
        assert_eq!((payload.len(), header.expiry()), (0, crate::time::Time::MAX));
    }

    #[test]
    fn endless_nesting_is_an_error_without_stack_overflow() {
        let list_in_list = vec![0x91; 100_000];
        let mut unknown_field = vec![0x81, 0xa1, b'y'];
        unknown_field.extend(&list_in_list);
        for payload in [list_in_list, unknown_field] {
            let message = Message::new(Header::new(Point::KIND, Tid::NONE, Tid::NONE), payload.into());
            assert!(message.decode::<Point>().is_err());
        }
    }

    #[test]
    fn unit_types_read_each_form_of_none() {
        #[derive(Debug, Serialize, serde::Deserialize)]
        struct Unit;
        #[derive(Debug, Serialize, serde::Deserialize)]
        struct Braces {}
        #[derive(Debug, Serialize, serde::Deserialize)]
        #[serde(default)]
        struct Angle {
            degrees: f64,
        }
        impl Default for Angle {
            fn default() -> Self {
                Self { degrees: 90.0 }
            }
        }
        impl Payload for Unit {
            const NAME: &'static str = "test.unit";
        }
        impl Payload for Braces {
            const NAME: &'static str = "test.braces";
        }
        impl Payload for Angle {
            const NAME: &'static str = "test.angle";
        }
        // As documented in docs/protocol/frame.md.
        assert_eq!((&encode(&Unit)[..], &encode(&Braces {})[..]), (&[0x90][..], &[0x80][..]));
        for bytes in [&[][..], &[0x80], &[0x90], &[0xc0]] {
            assert!(decode_as::<Unit>(bytes).is_ok() && decode_as::<Braces>(bytes).is_ok(), "{bytes:?}");
        }
        for bytes in [&[0x01][..], &[0xc2], &[0xa1, b'x']] {
            assert!(decode_as::<Unit>(bytes).is_err(), "{bytes:?}");
        }
        assert!(decode_as::<Angle>(&[]).is_err() && decode_as::<Angle>(&[0xc0]).is_err());
    }
}
