//! The bytes of a record.
//!
//! ```text
//! byte 0  version, 1
//!      1  form
//!      2  rejection: 0 if accepted, else the byte of the outcome on the wire
//!      3  zero, five bytes
//!      8  a message: its header in 64 bytes, as in a frame that stays in memory; then its payload
//!         a fact: MessagePack
//!         an outcome: 32 bytes, see [`OutcomeEntry`]
//! ```
//!
//! The payload of a message may be missing, if its reporter had no room for it. Its header has its length all the same.

use sinew_runtime::{
    outcome::Rejection,
    wire::{self, HEADER_LEN, Header, HeaderError},
};
use thiserror::Error;

use crate::{
    channel::{Form, refused_code, refused_of},
    facts::{ClockFact, Fact, LogFact, NodeFact},
    outcome::OutcomeEntry,
};

/// The version of the records that this code writes.
pub const VERSION: u8 = 1;
/// Bytes before a fact, and before the header of a message.
pub(crate) const HEAD: usize = 8;
/// Bytes before the payload of a message.
pub const MESSAGE_HEAD: usize = HEAD + HEADER_LEN;

/// Returns the bytes before the payload of a message of `length` bytes. It allocates nothing.
#[must_use]
pub fn message_head(
    form: Form,
    header: &Header,
    length: usize,
    refused: Option<Rejection>,
) -> [u8; MESSAGE_HEAD] {
    let mut bytes = [0; MESSAGE_HEAD];
    (bytes[0], bytes[1], bytes[2]) = (VERSION, form.code(), refused_code(refused));
    bytes[HEAD..].copy_from_slice(&header.encode_in_memory(length));
    bytes
}

/// Returns the record of a fact.
#[must_use]
pub fn fact<F: Fact>(fact: &F) -> Vec<u8> {
    let mut bytes = vec![VERSION, F::FORM.code(), 0, 0, 0, 0, 0, 0];
    bytes.extend_from_slice(&wire::encode(fact));
    bytes
}

/// A record that was read.
#[derive(Clone, Debug, PartialEq)]
pub enum Entry<'a> {
    /// A message.
    Message(MessageEntry<'a>),
    /// A change of nodes, applications or barriers.
    Node(NodeFact),
    /// The clocks.
    Clock(ClockFact),
    /// A line of the log.
    Log(LogFact),
    /// The outcome of a confirmed message.
    Outcome(OutcomeEntry),
}

/// A message.
#[derive(Clone, Copy, Debug, PartialEq)]
pub struct MessageEntry<'a> {
    /// Whether it was sent from this node, or came from another one.
    pub form: Form,
    /// Its header.
    pub header: Header,
    /// Bytes of its payload.
    pub length: usize,
    /// Its payload; `None` if the recorder had only its length.
    pub payload: Option<&'a [u8]>,
    /// Why it was rejected.
    pub refused: Option<Rejection>,
}

/// Why bytes are no record.
#[derive(Debug, Error)]
pub enum EntryError {
    /// They are too few.
    #[error("a record of {0} bytes is too short")]
    Short(usize),
    /// They were written by another version.
    #[error("the record has version {0}, and this program reads version {VERSION}; update the older one")]
    Version(u8),
    /// The form or the rejection is not assigned, or bytes that are zero are not.
    #[error("the record begins with bytes that have no meaning")]
    Form,
    /// The header is none.
    #[error("the header of a recorded message is wrong: {0}")]
    Header(#[from] HeaderError),
    /// The payload has another length than the header states.
    #[error("a recorded message has {found} bytes where its header states {stated}")]
    Length {
        /// Bytes that are there.
        found: usize,
        /// Bytes of the header.
        stated: usize,
    },
    /// The outcome has another length, or bytes without a meaning.
    #[error("a recorded outcome cannot be read")]
    Outcome,
    /// The fact cannot be decoded.
    #[error("a recorded fact cannot be read: {0}")]
    Fact(String),
}

impl<'a> Entry<'a> {
    /// Reads a record.
    ///
    /// # Errors
    /// The fault of its bytes.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew_record::{Entry, Form, message_head};
    /// use sinew_runtime::{tid::Tid, wire::{Header, Kind}};
    ///
    /// let header = Header::new(Kind::named("demo.torque"), Tid::NONE, Tid::NONE);
    /// let record = [&message_head(Form::Sent, &header, 3, None)[..], &[1, 2, 3]].concat();
    /// let Entry::Message(message) = Entry::read(&record)? else { panic!("it is a message") };
    /// assert_eq!((message.header, message.payload), (header, Some(&[1, 2, 3][..])));
    /// # Ok::<(), sinew_record::EntryError>(())
    /// ```
    pub fn read(bytes: &'a [u8]) -> Result<Self, EntryError> {
        let Some((head, rest)) = bytes.split_first_chunk::<HEAD>() else {
            return Err(EntryError::Short(bytes.len()));
        };
        let [version, form, refused, zeros @ ..] = *head;
        if version != VERSION {
            return Err(EntryError::Version(version));
        }
        let form = Form::from_code(form).filter(|_| zeros == [0; 5]).ok_or(EntryError::Form)?;
        let refused = refused_of(refused).ok_or(EntryError::Form)?;
        match form {
            Form::Sent | Form::Received => MessageEntry::read(form, refused, rest).map(Self::Message),
            Form::Node | Form::Clock | Form::Log | Form::Outcome if refused.is_some() => {
                Err(EntryError::Form)
            }
            Form::Node => read_fact(rest).map(Self::Node),
            Form::Clock => read_fact(rest).map(Self::Clock),
            Form::Log => read_fact(rest).map(Self::Log),
            Form::Outcome => OutcomeEntry::read(rest).map(Self::Outcome).ok_or(EntryError::Outcome),
        }
    }
}

fn read_fact<F: Fact>(bytes: &[u8]) -> Result<F, EntryError> {
    wire::decode(bytes).map_err(|error| EntryError::Fact(error.to_string()))
}

impl<'a> MessageEntry<'a> {
    fn read(form: Form, refused: Option<Rejection>, bytes: &'a [u8]) -> Result<Self, EntryError> {
        let Some((head, payload)) = bytes.split_first_chunk::<HEADER_LEN>() else {
            return Err(EntryError::Short(HEAD + bytes.len()));
        };
        let header = Header::decode_in_memory(head)?;
        let start = head.first_chunk::<8>().ok_or(EntryError::Short(HEAD))?;
        let length = Header::payload_len(start)? as usize;
        let payload = match payload.len() {
            found if found == length => Some(payload),
            0 => None,
            found => return Err(EntryError::Length { found, stated: length }),
        };
        Ok(Self { form, header, length, payload, refused })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use sinew_runtime::{
        tid::{NodeAddress, Tid},
        wire::Kind,
    };

    use super::*;
    use crate::facts::PeerClock;

    fn header() -> Header {
        Header::new(Kind::named("test.any"), Tid::from_bits(0x7f00_0001_0000_1001), Tid::from_bits(3))
    }

    #[test]
    fn message_is_read_as_it_was_written() {
        let refused = Some(Rejection::QueueFull);
        let record = [&message_head(Form::Received, &header(), 2, refused)[..], &[8, 9]].concat();
        let entry = MessageEntry {
            form: Form::Received,
            header: header(),
            length: 2,
            payload: Some(&[8, 9]),
            refused,
        };
        assert_eq!(Entry::read(&record).unwrap(), Entry::Message(entry));
        let entry = MessageEntry { payload: None, ..entry };
        assert_eq!(Entry::read(&record[..MESSAGE_HEAD]).unwrap(), Entry::Message(entry));
        assert!(matches!(
            Entry::read(&record[..=MESSAGE_HEAD]),
            Err(EntryError::Length { found: 1, stated: 2 })
        ));
    }

    #[test]
    fn fact_is_read_as_it_was_written() {
        let peer = PeerClock {
            node: NodeAddress::new(9),
            incarnation: sinew_runtime::tid::Incarnation(4),
            theirs_minus_ours_ns: -5,
            bound_ns: 80_000,
            drift_ppb: -1_500,
            drift_bound_ppb: 200,
        };
        let clock = ClockFact { wall_offset_ns: 1 << 60, peers: vec![peer] };
        assert_eq!(Entry::read(&fact(&clock)).unwrap(), Entry::Clock(clock));
        let log = LogFact { level: "warn".into(), target: "sinew::gncl".into(), text: "slow".into() };
        assert_eq!(Entry::read(&fact(&log)).unwrap(), Entry::Log(log));
        let restarted = NodeFact::Restarted {
            node: NodeAddress::new(9),
            app: None,
            name: "gncl".into(),
            supervisor: "layers".into(),
            restarts: 3,
            why: "panicked".into(),
        };
        assert_eq!(Entry::read(&fact(&restarted)).unwrap(), Entry::Node(restarted));
        let named = NodeFact::TypeNamed { kind: 7, name: "test.any".into() };
        assert_eq!(Entry::read(&fact(&named)).unwrap(), Entry::Node(named));
    }

    proptest! {
        /// Any bytes are a record or an error, and a message of them is written back as the same bytes.
        #[test]
        fn any_bytes_are_read_or_refused(
            changes in proptest::collection::vec((0..90_usize, any::<u8>()), 0..6),
            length in 0..90_usize,
        ) {
            let mut record = [&message_head(Form::Sent, &header(), 10, None)[..], &[1; 10]].concat();
            for (at, byte) in changes {
                if let Some(target) = record.get_mut(at) {
                    *target = byte;
                }
            }
            record.truncate(length);
            if let Ok(Entry::Message(message)) = Entry::read(&record) {
                let head = message_head(message.form, &message.header, message.length, message.refused);
                let crc = HEAD + 60..HEAD + 64;
                prop_assert_eq!(&head[..crc.start], &record[..crc.start]);
                prop_assert_eq!(message.payload.unwrap_or_default(), &record[MESSAGE_HEAD..]);
            }
        }
    }
}
