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
//!     13    1 flags: see [`Flags`]
//!     14    2 between two nodes: the lower 16 bits of its number in their session; from a node to its applications: how wrong the send
//!             time may be; else zero
//!     16    8 source TID
//!     24    8 destination TID
//!     32    8 sequence: the source's n-th message
//!     40    8 correlation: ties a reply or an outcome to its message
//!     48    8 send time, nanoseconds of the sender's monotonic clock
//!     56    4 time to live, microseconds; 0 = forever
//!     60    4 CRC-32 (IEEE 802.3) of bytes 0..60 and the payload
//! ```
//!
//! Bytes 0 to 8 keep their meaning in every later version, so that any two versions can reject each other
//! with a clear error.

mod length_guard;
#[cfg(test)]
mod tests;

use std::{sync::LazyLock, time::Duration};

use serde::{Deserialize, Serialize};

use self::length_guard::guard_of;
use crate::{tid::Tid, time::Time, wire::Kind};

/// First two bytes of every frame.
pub const MAGIC: [u8; 2] = *b"Sw";
/// The version of the protocol that this code implements.
pub const VERSION: u8 = 1;
/// Length of the header in bytes.
pub const HEADER_LEN: usize = 64;
/// The maximum time to live, sent as 32 bits of microseconds: 71 minutes and 35 s.
pub const TIME_TO_LIVE_MAX: Duration = Duration::from_micros(u32::MAX as u64);

/// The position of the length's guard in a guarded frame: the upper 16 bits of the sequence.
const GUARD_AT: usize = 38;
/// The largest sequence beside a guard: nine years at a million messages a second.
const SEQUENCE_MAX: u64 = (1 << 48) - 1;

/// The urgency of a message, and the effect of a newer one on an older one.
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
    /// Ordered, and before all other classes.
    #[default]
    Control,
    /// The newest value replaces older ones, for each source and kind: a late setpoint is a hazard.
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

/// The requests to a message's receiver: the bits of header byte 13.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Hash)]
pub struct Flags(u8);

impl Flags {
    /// No request.
    pub const NONE: Self = Self(0);
    /// Bit 0: the source requests the outcome.
    pub const CONFIRM: Self = Self(1);
    /// Bit 1: the source waits for a reply.
    pub const ASK: Self = Self(2);
    /// Bit 2: this is a reply; `correlation` names the request.
    pub const REPLY: Self = Self(4);
    /// Bit 3: this is the outcome of the message with this `correlation`.
    pub const OUTCOME: Self = Self(8);

    /// Bit 4: the sender's node retains this value for later members of the group.
    pub const KEEP: Self = Self(16);
    /// Bit 5: this is a retained value, handed over to a member that joined after it was sent.
    pub const RETAINED: Self = Self(32);

    const KNOWN: u8 = 0x3f;

    /// Returns the flags of both.
    #[must_use]
    pub const fn with(self, other: Self) -> Self {
        Self(self.0 | other.0)
    }

    /// Returns these flags except those of `other`.
    #[must_use]
    pub const fn without(self, other: Self) -> Self {
        Self(self.0 & !other.0)
    }

    /// Returns whether any flag of `other` is set.
    #[must_use]
    pub const fn has_any(self, other: Self) -> bool {
        self.0 & other.0 != 0
    }

    /// Returns whether all flags of `other` are set.
    #[must_use]
    pub const fn has(self, other: Self) -> bool {
        self.0 & other.0 == other.0
    }
}

/// The header of a message; `docs/protocol/frame.md` specifies its bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Header {
    /// The type of the payload.
    pub kind: Kind,
    /// The class of the message.
    pub class: Class,
    /// The requests to the receiver.
    pub flags: Flags,
    /// The sender. The sender's node guarantees this address.
    pub source: Tid,
    /// The destination.
    pub destination: Tid,
    /// Between two nodes: the lower 16 bits of the message's number in their session. From a node to its
    /// applications: the error of `sent` ([`sent_error`](Self::sent_error)). Otherwise zero.
    pub number: u16,
    /// The sequence number of the source, from 1.
    pub sequence: u64,
    /// Connects a reply or an outcome to its message; 0 without one.
    pub correlation: u64,
    /// When the message was sent. On the wire in the sender's clock; a receiving layer converts it to its
    /// own. If that is unknown it is the time of arrival, as [`sent_error`](Self::sent_error) shows.
    pub sent: Time,
    /// Microseconds after `sent` at which the message expires; 0: never. [`TIME_TO_LIVE_MAX`] is the maximum.
    pub time_to_live_us: u32,
}

impl Header {
    /// Creates a header of class Control without flags.
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

    /// Sets another class than that of the type. The values of a retained type keep theirs, so that none overtakes
    /// another one on its way to a group.
    pub const fn override_class(&mut self, class: Class) {
        if !self.flags.has(Flags::KEEP) {
            self.class = class;
        }
    }

    /// Sets the age at which the message expires, limited to the range of the wire: a microsecond to
    /// [`TIME_TO_LIVE_MAX`]. Returns how long to wait for its outcome: `within`, at most this maximum.
    #[must_use = "a wait beyond this time has no result"]
    pub fn set_time_to_live(&mut self, within: Duration) -> Duration {
        let within = within.min(TIME_TO_LIVE_MAX);
        // Zero would mean forever.
        self.time_to_live_us = u32::try_from(within.as_micros()).unwrap_or(u32::MAX).max(1);
        within
    }

    /// Same as [`set_time_to_live`](Self::set_time_to_live), but a shorter time to live of the message is kept.
    #[must_use = "a wait beyond this time has no result"]
    pub fn limit_time_to_live(&mut self, within: Duration) -> Duration {
        let own = self.time_to_live_us;
        let within = self.set_time_to_live(within);
        if own != 0 {
            self.time_to_live_us = self.time_to_live_us.min(own);
        }
        within
    }

    /// Returns whether the time to live has ended at `now`.
    #[must_use]
    #[inline]
    pub fn is_expired(&self, now: Time) -> bool {
        now > self.expiry()
    }

    /// Returns when the time to live ends; [`Time::MAX`] if it never does.
    #[must_use]
    #[inline]
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

    /// Writes the first 64 bytes of a frame that stays in memory, for a payload of `length` bytes. Its
    /// checksum is 0 and is not checked, because memory is no wire.
    ///
    /// # Panics
    /// Never for payloads below 4 GiB, which every configured limit is.
    #[must_use]
    #[inline]
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

    /// Same as [`encode`](Self::encode), with a guard of the length in the upper 16 bits of the sequence,
    /// which no source's messages ever reach. A reader then detects a corrupted length before it waits for
    /// that many bytes.
    ///
    /// # Panics
    /// Never for payloads below 4 GiB, which every configured limit is.
    #[must_use]
    #[inline]
    pub fn encode_guarded(&self, payload: &[u8]) -> [u8; HEADER_LEN] {
        let mut bytes = self.encode_in_memory(payload.len());
        let guard = guard_of(u32::from_le_bytes(field(&bytes, 4)));
        bytes[GUARD_AT..GUARD_AT + 2].copy_from_slice(&guard);
        let crc = checksum(&bytes, payload);
        bytes[60..64].copy_from_slice(&crc.to_le_bytes());
        bytes
    }

    /// Checks the guard of a length, before the length is used.
    ///
    /// # Errors
    /// The bytes were corrupted, or are not the start of a frame.
    pub fn check_guard(bytes: &[u8; HEADER_LEN]) -> Result<(), HeaderError> {
        Self::check_guard_of(bytes, Self::payload_len(&field(bytes, 0))?)
    }

    /// Same as [`check_guard`](Self::check_guard), for a length that was read from these bytes.
    #[inline]
    pub(super) fn check_guard_of(bytes: &[u8; HEADER_LEN], length: u32) -> Result<(), HeaderError> {
        if field::<2>(bytes, GUARD_AT) == guard_of(length) { Ok(()) } else { Err(HeaderError::Guard) }
    }

    /// Reads a header that [`encode_guarded`](Self::encode_guarded) wrote, and checks it against its payload.
    ///
    /// # Errors
    /// As [`decode`](Self::decode).
    #[inline]
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
        if [bytes[0], bytes[1]] != MAGIC {
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
    /// The fault in the bytes; the peer or the network caused it.
    #[inline]
    pub fn decode(bytes: &[u8; HEADER_LEN], payload: &[u8]) -> Result<Self, HeaderError> {
        let length = Self::payload_len(&field(bytes, 0))?;
        if length as usize != payload.len() {
            return Err(HeaderError::Length { declared: length, found: payload.len() });
        }
        if u32::from_le_bytes(field(bytes, 60)) != checksum(bytes, payload) {
            return Err(HeaderError::Checksum);
        }
        Self::decode_fields(bytes)
    }

    /// Reads a header that [`encode_in_memory`](Self::encode_in_memory) wrote. The caller must check its length.
    ///
    /// # Errors
    /// The fault in the bytes; the peer caused it.
    #[inline]
    pub fn decode_in_memory(bytes: &[u8; HEADER_LEN]) -> Result<Self, HeaderError> {
        Self::payload_len(&field(bytes, 0))?;
        Self::decode_fields(bytes)
    }

    /// Reads all fields but the length, which the caller has read.
    #[inline]
    fn decode_fields(bytes: &[u8; HEADER_LEN]) -> Result<Self, HeaderError> {
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

/// Returns the `N` bytes of a header from `at`; every caller stays inside the 64.
fn field<const N: usize>(bytes: &[u8; HEADER_LEN], at: usize) -> [u8; N] {
    let mut out = [0; N];
    out.copy_from_slice(&bytes[at..at + N]);
    out
}

/// Returns the CRC-32 that this number of zeros turns into that of no bytes.
const fn crc_before_zeros(zeros: usize) -> u32 {
    /// The polynomial, lowest bit first.
    const POLYNOMIAL: u32 = 0xedb8_8320;
    let (mut register, mut bits) = (u32::MAX, 8 * zeros);
    while bits > 0 {
        let was_reduced = register >> 31 == 1;
        register = if was_reduced { (register ^ POLYNOMIAL) << 1 | 1 } else { register << 1 };
        bits -= 1;
    }
    !register
}

/// Minimum number of zeros before a header: its first 60 bytes are whole blocks of 16 bytes with them.
const ZEROS_MIN: usize = 4;
/// Length of the block that starts a long frame: the shortest that is read by the CPU's carry-less multiplication.
const FIRST_BLOCK: usize = 128;
/// Maximum number of bytes of the payload in that block.
const FIRST_OF_PAYLOAD: usize = FIRST_BLOCK - 60 - ZEROS_MIN;

/// Hashers that are to read 4 to 19 zeros first. A new one detects the CPU's features again, which costs as much
/// as 60 bytes.
static HASHERS_BEFORE_ZEROS: LazyLock<[crc32fast::Hasher; 16]> = LazyLock::new(|| {
    std::array::from_fn(|more| crc32fast::Hasher::new_with_initial(crc_before_zeros(ZEROS_MIN + more)))
});

/// Returns the CRC-32 of the header's first 60 bytes and the payload. With zeros before them, and with the first
/// bytes of a longer payload, they are whole blocks of 16 bytes. The rest of the payload is whole blocks too. A
/// rest of a block is read byte by byte, which costs as much as 16 times as many bytes.
fn checksum(header: &[u8; HEADER_LEN], payload: &[u8]) -> u32 {
    let Some(first) = payload.first_chunk::<FIRST_OF_PAYLOAD>() else {
        let mut blocks = [0; ZEROS_MIN + 60];
        blocks[ZEROS_MIN..].copy_from_slice(&header[..60]);
        let mut crc = HASHERS_BEFORE_ZEROS[0].clone();
        crc.update(&blocks);
        crc.update(payload);
        return crc.finalize();
    };
    let more_zeros = (FIRST_OF_PAYLOAD - payload.len() % 16) % 16;
    let start = ZEROS_MIN + more_zeros;
    // The bytes of `first` that do not belong to the block lie behind it: copies of a fixed length are fast.
    let mut block = [0; FIRST_BLOCK + 16];
    block[start..start + 60].copy_from_slice(&header[..60]);
    block[start + 60..start + 60 + FIRST_OF_PAYLOAD].copy_from_slice(first);
    let mut crc = HASHERS_BEFORE_ZEROS[more_zeros].clone();
    crc.update(&block[..FIRST_BLOCK]);
    crc.update(&payload[FIRST_OF_PAYLOAD - more_zeros..]);
    crc.finalize()
}

/// The reason why this node cannot use a header. The peer or the network caused it; nothing changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum HeaderError {
    /// The magic bytes or the header's length are wrong.
    #[error("these bytes are not a Sinew frame")]
    NotAFrame,
    /// The peer uses another version.
    #[error(
        "the peer speaks version {theirs} of the protocol and this node version {VERSION}; update the older one"
    )]
    Version {
        /// The version in the frame.
        theirs: u8,
    },
    /// The payload is shorter or longer than the length in the header.
    #[error("the header declares {declared} payload bytes, and {found} are there")]
    Length {
        /// The length in the header.
        declared: u32,
        /// The actual length.
        found: usize,
    },
    /// The bytes were corrupted.
    #[error("the checksum is wrong: the frame was damaged on its way")]
    Checksum,
    /// The length was corrupted.
    #[error("the length does not match its guard: the frame was damaged on its way")]
    Guard,
    /// Bits that this version keeps at zero are set.
    #[error("reserved bits are set")]
    Reserved,
    /// The class byte is not assigned.
    #[error("there is no message class {0}")]
    Class(u8),
}
