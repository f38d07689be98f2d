//! The fixed header: 64 bytes, little-endian, before every payload.
//!
//! ```text
//! offset size field
//!      0    2 magic "Sw"
//!      2    1 version of the protocol, 1
//!      3    1 length of this header in bytes, 64
//!      4    4 length of the payload in bytes
//!      8    4 kind of the payload
//!     12    1 class: 0 Control, 1 Stream, 2 Bulk
//!     13    1 flags
//!     14    2 between two nodes: the lower 16 bits of its number in their session; from a node to its applications: how wrong the send
//!             time may be; else zero
//!     16    8 source TID
//!     24    8 destination TID
//!     32    8 sequence: the source's n-th message
//!     40    8 correlation: ties a reply or an outcome to its message
//!     48    8 send time, nanoseconds of the sender's monotonic clock
//!     56    4 time to live, microseconds; 0 = for ever
//!     60    4 CRC-32 (IEEE 802.3) of bytes 0..60 and the payload
//! ```
//!
//! Bytes 0 to 8 keep their meaning in every later version, so that any two versions can refuse each other in words.

use std::time::Duration;

use serde::{Deserialize, Serialize};

use crate::{tid::Tid, time::Time, wire::Kind};

/// First two bytes of every frame.
pub const MAGIC: [u8; 2] = *b"Sw";
/// The version of the protocol that this code speaks.
pub const VERSION: u8 = 1;
/// Length of the header in bytes.
pub const HEADER_LEN: usize = 64;
/// The longest time to live, as it travels in 32 bits of microseconds: 71 minutes and 35 s.
pub const TIME_TO_LIVE_MAX: Duration = Duration::from_micros(u32::MAX as u64);

/// Where a guarded frame has the guard of its length: the upper 16 bits of the sequence.
const GUARD_AT: usize = 38;
/// The largest sequence beside a guard: at a million messages a second that is nine years.
const SEQUENCE_MAX: u64 = (1 << 48) - 1;

/// How urgent a message is, and what a newer one does to an older.
///
/// # Examples
///
/// ```
/// use sinew::{Class, Payload, payload};
///
/// payload!("demo.calibrate" => struct Calibrate;); // a command: Control
/// payload!("demo.angle", Stream => struct Angle { degrees: f32 }); // a measurement: only the newest waits
/// payload!("demo.record", Bulk => struct Record { samples: Vec<f32> }); // gives way to both
///
/// assert_eq!([Calibrate::CLASS, Angle::CLASS, Record::CLASS], Class::ALL);
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
pub enum Class {
    /// Ordered and ahead of all else.
    #[default]
    Control,
    /// Newest value wins, for each source and kind: a late setpoint is a hazard.
    Stream,
    /// Ordered; yields to the other classes.
    Bulk,
}

impl Class {
    /// Every class, most urgent first.
    pub const ALL: [Self; 3] = [Self::Control, Self::Stream, Self::Bulk];

    const fn code(self) -> u8 {
        match self {
            Self::Control => 0,
            Self::Stream => 1,
            Self::Bulk => 2,
        }
    }

    fn from_code(code: u8) -> Option<Self> {
        Self::ALL.get(usize::from(code)).copied()
    }
}

/// What is asked of a message's receiver: the bits of header byte 13.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Flags(u8);

impl Flags {
    /// Nothing is asked.
    pub const NONE: Self = Self(0);
    /// Bit 0: the source wants to know the outcome.
    pub const CONFIRM: Self = Self(1);
    /// Bit 1: the source waits for a reply.
    pub const ASK: Self = Self(2);
    /// Bit 2: this is a reply; `correlation` names the request.
    pub const REPLY: Self = Self(4);
    /// Bit 3: this is the outcome of the message that `correlation` names.
    pub const OUTCOME: Self = Self(8);

    const KNOWN: u8 = 0x0f;

    /// The flags of both.
    #[must_use]
    pub const fn with(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    /// These flags except those of `other`.
    #[must_use]
    pub const fn without(self, other: Self) -> Self {
        Self(self.0 & !other.0)
    }

    /// Whether all flags of `other` are set.
    #[must_use]
    pub const fn has(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }
}

/// The header of a message; `docs/protocol/frame.md` has its bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    /// Type of the payload.
    pub kind: Kind,
    /// How urgent it is.
    pub class: Class,
    /// What is asked of the receiver.
    pub flags: Flags,
    /// Who sent it. The sender's node answers for it.
    pub source: Tid,
    /// Whom it is for.
    pub destination: Tid,
    /// Between two nodes: the lower 16 bits of its number in their session. From a node to its applications: how wrong `sent` may be
    /// ([`sent_error`](Self::sent_error)). Else zero.
    pub number: u16,
    /// The source's n-th message, from 1.
    pub sequence: u64,
    /// Ties a reply or an outcome to its message; 0 where there is none.
    pub correlation: u64,
    /// When it was sent. On the wire in the sender's clock; a receiving layer turns it into its own. Where that is not known it is when it
    /// arrived, and [`sent_error`](Self::sent_error) says so.
    pub sent: Time,
    /// How long after `sent` it is still worth handling, in microseconds; 0 = for ever. [`TIME_TO_LIVE_MAX`] is the longest.
    pub time_to_live_us: u32,
}

impl Header {
    /// A header of class Control with nothing asked.
    #[must_use]
    pub const fn new(kind: Kind, source: Tid, destination: Tid) -> Self {
        Self {
            kind,
            class: Class::Control,
            flags: Flags::NONE,
            source,
            destination,
            number: 0,
            sequence: 0,
            correlation: 0,
            sent: Time::ZERO,
            time_to_live_us: 0,
        }
    }

    /// Has it expire when it is older than `within`, which is cut to what the wire has room for: a microsecond to [`TIME_TO_LIVE_MAX`].
    /// Returns how long whoever waits for what becomes of it is to wait: as long, and no longer than the longest of these.
    #[must_use = "who waits longer waits for what nobody says any more"]
    pub fn set_time_to_live(&mut self, within: Duration) -> Duration {
        let within = within.min(TIME_TO_LIVE_MAX);
        // Zero would be for ever.
        self.time_to_live_us = u32::try_from(within.as_micros()).unwrap_or(u32::MAX).max(1);
        within
    }

    /// The same for a message whose own time to live may be shorter: that stays.
    #[must_use = "who waits longer waits for what nobody says any more"]
    pub fn limit_time_to_live(&mut self, within: Duration) -> Duration {
        let own = self.time_to_live_us;
        let within = self.set_time_to_live(within);
        if own != 0 {
            self.time_to_live_us = self.time_to_live_us.min(own);
        }
        within
    }

    /// Whether the time to live has run out at `now`.
    #[must_use]
    pub fn is_expired(&self, now: Time) -> bool {
        now > self.expiry()
    }

    /// When the time to live runs out; [`Time::MAX`] if it never does.
    #[must_use]
    pub fn expiry(&self) -> Time {
        match self.time_to_live_us {
            0 => Time::MAX,
            micros => self.sent + Duration::from_micros(u64::from(micros)),
        }
    }

    /// Writes the frame's first 64 bytes for `payload`.
    ///
    /// # Panics
    /// Never for payloads below 4 GiB, which every configured limit is.
    #[must_use]
    pub fn encode(&self, payload: &[u8]) -> [u8; HEADER_LEN] {
        let mut bytes = self.encode_in_memory(payload.len());
        let crc = checksum(&bytes, payload);
        bytes[60..64].copy_from_slice(&crc.to_le_bytes());
        bytes
    }

    /// Writes the first 64 bytes of a frame that stays in memory, for a payload of `length` bytes: its checksum is 0 and
    /// is not looked at, because memory is no wire.
    ///
    /// # Panics
    /// Never for payloads below 4 GiB, which every configured limit is.
    #[must_use]
    pub fn encode_in_memory(&self, length: usize) -> [u8; HEADER_LEN] {
        let length = u32::try_from(length).expect("the frame limit is below 4 GiB");
        let mut bytes = [0; HEADER_LEN];
        bytes[0..2].copy_from_slice(&MAGIC);
        bytes[2] = VERSION;
        bytes[3] = HEADER_LEN as u8;
        bytes[4..8].copy_from_slice(&length.to_le_bytes());
        bytes[8..12].copy_from_slice(&self.kind.bits().to_le_bytes());
        bytes[12] = self.class.code();
        bytes[13] = self.flags.0;
        bytes[14..16].copy_from_slice(&self.number.to_le_bytes());
        bytes[16..24].copy_from_slice(&self.source.bits().to_le_bytes());
        bytes[24..32].copy_from_slice(&self.destination.bits().to_le_bytes());
        bytes[32..40].copy_from_slice(&self.sequence.to_le_bytes());
        bytes[40..48].copy_from_slice(&self.correlation.to_le_bytes());
        bytes[48..56].copy_from_slice(&self.sent.as_nanos().to_le_bytes());
        bytes[56..60].copy_from_slice(&self.time_to_live_us.to_le_bytes());
        bytes
    }

    /// As [`encode`](Self::encode), with a guard of the length in the upper 16 bits of the sequence, which no source's messages
    /// ever reach: who reads it finds a damaged length before it waits for so many bytes.
    ///
    /// # Panics
    /// Never for payloads below 4 GiB, which every configured limit is.
    #[must_use]
    pub fn encode_guarded(&self, payload: &[u8]) -> [u8; HEADER_LEN] {
        let mut bytes = self.encode_in_memory(payload.len());
        let guard = guard_of(&bytes);
        bytes[GUARD_AT..GUARD_AT + 2].copy_from_slice(&guard);
        let crc = checksum(&bytes, payload);
        bytes[60..64].copy_from_slice(&crc.to_le_bytes());
        bytes
    }

    /// Checks the guard of a length, before anything is done because of it.
    ///
    /// # Errors
    /// The bytes changed on their way.
    pub fn check_guard(bytes: &[u8; HEADER_LEN]) -> Result<(), HeaderError> {
        if field::<2>(bytes, GUARD_AT) == guard_of(bytes) { Ok(()) } else { Err(HeaderError::Guard) }
    }

    /// Reads a header that [`encode_guarded`](Self::encode_guarded) wrote, and checks it against its payload.
    ///
    /// # Errors
    /// As [`decode`](Self::decode).
    pub fn decode_guarded(bytes: &[u8; HEADER_LEN], payload: &[u8]) -> Result<Self, HeaderError> {
        let mut header = Self::decode(bytes, payload)?;
        header.sequence &= SEQUENCE_MAX;
        Ok(header)
    }

    /// Reads the length of the payload from the first 8 bytes of a frame: the part that every version shares.
    ///
    /// # Errors
    /// The bytes are not the start of a frame, or of a frame of another version.
    pub fn payload_len(bytes: &[u8; 8]) -> Result<u32, HeaderError> {
        if bytes[0..2] != MAGIC {
            return Err(HeaderError::NotAFrame);
        }
        if bytes[2] != VERSION {
            return Err(HeaderError::Version { theirs: bytes[2] });
        }
        if usize::from(bytes[3]) != HEADER_LEN {
            return Err(HeaderError::NotAFrame);
        }
        Ok(u32::from_le_bytes([bytes[4], bytes[5], bytes[6], bytes[7]]))
    }

    /// Reads a header and checks it against its payload.
    ///
    /// # Errors
    /// What is wrong with the bytes; the peer is at fault, or the network.
    pub fn decode(bytes: &[u8; HEADER_LEN], payload: &[u8]) -> Result<Self, HeaderError> {
        let length = Self::payload_len(&field(bytes, 0))?;
        if length as usize != payload.len() {
            return Err(HeaderError::Length { said: length, found: payload.len() });
        }
        if u32::from_le_bytes(field(bytes, 60)) != checksum(bytes, payload) {
            return Err(HeaderError::Checksum);
        }
        Self::decode_in_memory(bytes)
    }

    /// Reads a header that [`encode_in_memory`](Self::encode_in_memory) wrote. Its length is the caller's to check.
    ///
    /// # Errors
    /// What is wrong with the bytes; the peer is at fault.
    pub fn decode_in_memory(bytes: &[u8; HEADER_LEN]) -> Result<Self, HeaderError> {
        Self::payload_len(&field(bytes, 0))?;
        if bytes[13] & !Flags::KNOWN != 0 {
            return Err(HeaderError::Reserved);
        }
        Ok(Self {
            kind: Kind::from_bits(u32::from_le_bytes(field(bytes, 8))),
            class: Class::from_code(bytes[12]).ok_or(HeaderError::Class(bytes[12]))?,
            flags: Flags(bytes[13]),
            source: Tid::from_bits(u64::from_le_bytes(field(bytes, 16))),
            destination: Tid::from_bits(u64::from_le_bytes(field(bytes, 24))),
            number: u16::from_le_bytes(field(bytes, 14)),
            sequence: u64::from_le_bytes(field(bytes, 32)),
            correlation: u64::from_le_bytes(field(bytes, 40)),
            sent: Time::from_nanos(u64::from_le_bytes(field(bytes, 48))),
            time_to_live_us: u32::from_le_bytes(field(bytes, 56)),
        })
    }
}

/// The `N` bytes of a header from `at`; every caller stays inside the 64.
fn field<const N: usize>(bytes: &[u8; HEADER_LEN], at: usize) -> [u8; N] {
    let mut out = [0; N];
    out.copy_from_slice(&bytes[at..at + N]);
    out
}

/// The lower 16 bits of the CRC-32 of magic, version and lengths.
fn guard_of(header: &[u8; HEADER_LEN]) -> [u8; 2] {
    (crc32fast::hash(&header[..8]) as u16).to_le_bytes()
}

fn checksum(header: &[u8; HEADER_LEN], payload: &[u8]) -> u32 {
    let mut crc = crc32fast::Hasher::new();
    crc.update(&header[..60]);
    crc.update(payload);
    crc.finalize()
}

/// Why bytes are not a header that this node can use. The peer or the network is at fault; nothing changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum HeaderError {
    /// The magic bytes or the header's length are wrong.
    #[error("these bytes are not a Sinew frame")]
    NotAFrame,
    /// The peer speaks another version.
    #[error(
        "the peer speaks version {theirs} of the protocol and this node version {VERSION}; update the older one"
    )]
    Version {
        /// The version in the frame.
        theirs: u8,
    },
    /// The payload is shorter or longer than the header says.
    #[error("the header says {said} payload bytes and {found} are there")]
    Length {
        /// Length in the header.
        said: u32,
        /// Length found.
        found: usize,
    },
    /// The bytes changed on their way.
    #[error("the checksum is wrong: the frame was damaged on its way")]
    Checksum,
    /// The length changed on its way.
    #[error("the length is not what its guard says: the frame was damaged on its way")]
    Guard,
    /// Bits that this version keeps at zero are set.
    #[error("reserved bits are set")]
    Reserved,
    /// The class byte means nothing.
    #[error("there is no message class {0}")]
    Class(u8),
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn any_header() -> impl Strategy<Value = Header> {
        (any::<[u64; 5]>(), any::<[u32; 2]>(), any::<u16>(), 0u8..3, 0u8..16).prop_map(
            |(long, short, number, class, flags)| Header {
                kind: Kind::from_bits(short[0]),
                class: Class::from_code(class).unwrap(),
                flags: Flags(flags),
                source: Tid::from_bits(long[0]),
                destination: Tid::from_bits(long[1]),
                number,
                sequence: long[2],
                correlation: long[3],
                sent: Time::from_nanos(long[4]),
                time_to_live_us: short[1],
            },
        )
    }

    proptest! {
        #[test]
        fn what_is_written_is_read_back(header in any_header(), payload: Vec<u8>) {
            prop_assert_eq!(Header::decode(&header.encode(&payload), &payload), Ok(header));
        }

        #[test]
        fn one_flipped_bit_is_noticed(header in any_header(), payload: Vec<u8>, bit in 0usize..512) {
            let mut bytes = header.encode(&payload);
            bytes[bit / 8] ^= 1 << (bit % 8);
            prop_assert!(Header::decode(&bytes, &payload).is_err());
        }

        #[test]
        fn a_guarded_header_is_read_back_and_by_those_who_know_no_guard_but_for_its_sequence(
            header in any_header(), payload: Vec<u8>,
        ) {
            let header = Header { sequence: header.sequence & SEQUENCE_MAX, ..header };
            let bytes = header.encode_guarded(&payload);
            prop_assert_eq!(Header::check_guard(&bytes), Ok(()));
            prop_assert_eq!(Header::decode_guarded(&bytes, &payload), Ok(header));
            let plain = Header::decode(&bytes, &payload).unwrap();
            prop_assert_eq!(Header { sequence: header.sequence, ..plain }, header);
        }

        #[test]
        fn one_or_two_flipped_bits_in_a_length_or_its_guard_are_noticed_without_the_payload(
            header in any_header(), payload: Vec<u8>, first in 32usize..80, second in 32usize..80,
        ) {
            let mut bytes = header.encode_guarded(&payload);
            // Of 48 bits the first 32 are the length, the others the guard.
            let mut flip = |bit: usize| {
                let bit = if bit < 64 { bit } else { GUARD_AT * 8 + bit - 64 };
                bytes[bit / 8] ^= 1 << (bit % 8);
            };
            flip(first);
            if second != first {
                flip(second);
            }
            prop_assert_eq!(Header::check_guard(&bytes), Err(HeaderError::Guard));
        }

        #[test]
        fn any_bytes_are_a_header_or_an_error(bytes in proptest::collection::vec(any::<u8>(), 64), payload: Vec<u8>) {
            let bytes: [u8; 64] = bytes.try_into().unwrap();
            let _ = Header::decode(&bytes, &payload);
        }
    }

    #[test]
    fn another_version_is_named_before_anything_else_is_believed() {
        let mut bytes = Header::new(Kind::OUTCOME, Tid::NONE, Tid::NONE).encode(&[]);
        bytes[2] = 9;
        assert_eq!(Header::decode(&bytes, &[]), Err(HeaderError::Version { theirs: 9 }));
    }

    #[test]
    fn a_time_to_live_is_never_for_ever_nor_another_one_where_it_is_too_long_for_the_wire() {
        let (micro, most) = (Duration::from_micros(1), TIME_TO_LIVE_MAX);
        assert_eq!(
            most.as_secs(),
            71 * 60 + 34,
            "and 0.967 s: 71 minutes and 35 s, as the documentation says"
        );
        let cases = [
            (Duration::ZERO, 1, Duration::ZERO),
            (Duration::from_nanos(1), 1, Duration::from_nanos(1)),
            (Duration::from_secs(3_600), 3_600_000_000, Duration::from_secs(3_600)),
            (most - micro, u32::MAX - 1, most - micro),
            (most, u32::MAX, most),
            (most + micro, u32::MAX, most),
            // Cut to 32 bits these would be 1 us and 2 us.
            (micro * 2 + most, u32::MAX, most),
            (Duration::from_secs(48 * 3_600), u32::MAX, most),
            (Duration::MAX, u32::MAX, most),
        ];
        for (within, micros, waits) in cases {
            let mut header = Header::new(Kind::OUTCOME, Tid::NONE, Tid::NONE);
            assert_eq!(
                (header.set_time_to_live(within), header.time_to_live_us),
                (waits, micros),
                "{within:?}"
            );
        }
    }

    #[test]
    fn time_to_live_counts_from_the_send_time() {
        let mut header = Header::new(Kind::OUTCOME, Tid::NONE, Tid::NONE);
        header.sent = Time::from_nanos(1_000);
        assert!(!header.is_expired(Time::MAX));
        header.time_to_live_us = 1;
        assert!(!header.is_expired(Time::from_nanos(2_000)));
        assert!(header.is_expired(Time::from_nanos(2_001)));
    }
}
