//! The layout of a journal's file.
//!
//! ```text
//! byte 0        identity, sizes, clock and writer      written once, before the file has its name
//! byte 2048     reserved                               bytes ever reserved in the ring
//! byte 2176     wall offset, closed                    see `Header` and `CLOSED_AT`
//! byte 4096     the table of channels                  4,096 places of 64 bytes
//! byte 266240   the ring                               a power of two
//! ```
//!
//! Numbers have the byte order of the host: a host of another order finds no magic. A record begins at a multiple of
//! [`ALIGN`]:
//!
//! ```text
//! bytes 0  8 stamp: position since the start of the journal, exclusive-or the file's salt, or the state (1 or 2)
//!       8  4 length of the payload
//!      12  2 place of the channel in the table
//!      14  2 zero
//!      16  8 number in the channel, from 1
//!      24  8 time, nanoseconds of the writer's monotonic clock
//!      32  4 CRC-32 of the position, bytes 8..32 and the payload
//!      36  4 zero
//!      40    payload
//! ```
//!
//! A record may continue at the ring's start. The salt is a random number that senders do not know, so that no
//! payload can pretend to be a record.

use std::sync::LazyLock;

use super::error::JournalHeaderError;

/// "SINEWJRN", read as little-endian.
pub(crate) const MAGIC: u64 = u64::from_le_bytes(*b"SINEWJRN");
/// Changes whenever a byte changes its meaning.
pub(crate) const VERSION: u32 = 1;
/// The page of the header.
pub(crate) const HEADER_BYTES: usize = 4096;
/// Offset of the count of reserved bytes. It has cache lines for itself: all writers change it.
pub(crate) const RESERVED_AT: usize = 2048;
/// Offset of the wall clock's offset, which changes when that clock is set.
pub(crate) const WALL_OFFSET_AT: usize = 2176;
/// Offset of the word that is 1 after the writer has closed the journal.
pub(crate) const CLOSED_AT: usize = 2184;
/// Places of the table of channels.
pub(crate) const PLACES: usize = 4096;
/// Bytes of a place.
pub(crate) const PLACE_BYTES: usize = 64;
/// Words of a place.
pub(crate) const PLACE_WORDS: usize = PLACE_BYTES / 8;
/// Offset of the table of channels.
pub(crate) const TABLE_AT: usize = HEADER_BYTES;
/// Bytes of the table.
pub(crate) const TABLE_BYTES: usize = PLACES * PLACE_BYTES;
/// Offset of the ring.
pub(crate) const RING_AT: usize = TABLE_AT + TABLE_BYTES;
/// Records begin at multiples of this.
pub(crate) const ALIGN: u64 = 32;
/// Bytes of a record before its payload.
pub(crate) const RECORD_HEAD: usize = 40;
/// The smallest ring: one payload of 16 KiB fits.
pub(crate) const RING_MIN: u64 = 64 * 1024;
/// The largest ring.
pub(crate) const RING_MAX: u64 = 1 << 32;

/// Maximum bytes of the identity that the creator gives.
pub const IDENTITY_MAX: usize = 1024;

const IDENTITY_AT: usize = 128;
const CRC_AT: usize = 96;

/// The state of a record, in the lower bits of its stamp.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum State {
    /// Its place and its length are known, and its writer copies.
    Writing = 1,
    /// It is whole.
    Written = 2,
}

/// Returns the first word of the record at `position` in this state.
pub(crate) const fn stamp(position: u64, state: State, salt: u64) -> u64 {
    (position ^ salt) | state as u64
}

/// A random number as a salt: the bits of the state are 0.
pub(crate) const fn salt_of(random: u64) -> u64 {
    random & !(ALIGN - 1)
}

/// Returns the bytes of the ring that a record with such a payload takes.
pub(crate) const fn record_bytes(payload: usize) -> u64 {
    ((RECORD_HEAD + payload) as u64).next_multiple_of(ALIGN)
}

/// Returns the longest payload that a ring of this size takes: a quarter of it, less the record's head.
pub(crate) const fn payload_max(ring_bytes: u64) -> usize {
    (ring_bytes / 4) as usize - RECORD_HEAD
}

/// The head of a record, without its stamp.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Head {
    pub(crate) length: u32,
    pub(crate) place: u16,
    pub(crate) number: u64,
    pub(crate) time: u64,
}

impl Head {
    /// Returns the words after the stamp, without that of the checksum.
    pub(crate) fn words(&self) -> [u64; 3] {
        [u64::from(self.length) | u64::from(self.place) << 32, self.number, self.time]
    }

    /// Reads the words after the stamp. `None` if there is no such place, or bits are set that are zero in this
    /// version.
    pub(crate) fn of([first, number, time]: [u64; 3]) -> Option<Self> {
        let place = u16::try_from(first >> 32).ok().filter(|place| usize::from(*place) < PLACES)?;
        Some(Self { length: first as u32, place, number, time })
    }
}

/// A new hasher detects the CPU's features again, which costs as much as 60 bytes.
static HASHER: LazyLock<crc32fast::Hasher> = LazyLock::new(crc32fast::Hasher::new);

/// Returns a hasher that has read the head of the record at `position`.
pub(crate) fn hasher(position: u64, head: &Head) -> crc32fast::Hasher {
    let mut bytes = [0; 32];
    let words = [position].into_iter().chain(head.words());
    for (target, word) in bytes.as_chunks_mut::<8>().0.iter_mut().zip(words) {
        *target = word.to_ne_bytes();
    }
    let mut hasher = HASHER.clone();
    hasher.update(&bytes);
    hasher
}

/// The part of the file that is written once.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Header {
    pub(crate) ring_bytes: u64,
    pub(crate) salt: u64,
    pub(crate) created: u64,
    pub(crate) writer: u32,
    pub(crate) identity: Vec<u8>,
}

impl Header {
    /// Returns the bytes of the file with this header.
    pub(crate) const fn file_bytes(&self) -> u64 {
        RING_AT as u64 + self.ring_bytes
    }

    /// Returns the page, or `None` if the identity is too long.
    pub(crate) fn encode(&self) -> Option<[u8; HEADER_BYTES]> {
        let mut page = [0; HEADER_BYTES];
        put(&mut page, 0, &MAGIC.to_ne_bytes());
        put(&mut page, 8, &VERSION.to_ne_bytes());
        put(&mut page, 12, &(PLACES as u32).to_ne_bytes());
        put(&mut page, 16, &self.ring_bytes.to_ne_bytes());
        put(&mut page, 24, &self.salt.to_ne_bytes());
        put(&mut page, 32, &self.created.to_ne_bytes());
        put(&mut page, 40, &self.writer.to_ne_bytes());
        let length = u32::try_from(self.identity.len()).ok()?;
        put(&mut page, 44, &length.to_ne_bytes());
        page.get_mut(IDENTITY_AT..IDENTITY_AT + IDENTITY_MAX)?
            .get_mut(..self.identity.len())?
            .copy_from_slice(&self.identity);
        let crc = checksum(&page);
        put(&mut page, CRC_AT, &crc.to_ne_bytes());
        Some(page)
    }

    /// Reads a page. Every number in it is checked.
    pub(crate) fn decode(page: &[u8; HEADER_BYTES]) -> Result<Self, JournalHeaderError> {
        if u64::from_ne_bytes(field(page, 0)) != MAGIC {
            return Err(JournalHeaderError::Magic);
        }
        let version = u32::from_ne_bytes(field(page, 8));
        if version != VERSION {
            return Err(JournalHeaderError::Version(version));
        }
        if u32::from_ne_bytes(field(page, CRC_AT)) != checksum(page) {
            return Err(JournalHeaderError::Checksum);
        }
        let ring_bytes = u64::from_ne_bytes(field(page, 16));
        let is_ring = ring_bytes.is_power_of_two() && (RING_MIN..=RING_MAX).contains(&ring_bytes);
        let salt = u64::from_ne_bytes(field(page, 24));
        let identity = u32::from_ne_bytes(field(page, 44)) as usize;
        if u32::from_ne_bytes(field(page, 12)) as usize != PLACES
            || !is_ring
            || salt_of(salt) != salt
            || identity > IDENTITY_MAX
        {
            return Err(JournalHeaderError::Sizes);
        }
        Ok(Self {
            ring_bytes,
            salt,
            created: u64::from_ne_bytes(field(page, 32)),
            writer: u32::from_ne_bytes(field(page, 40)),
            identity: page[IDENTITY_AT..IDENTITY_AT + identity].to_vec(),
        })
    }
}

/// Returns the CRC-32 of what is written once, without the place of the CRC.
fn checksum(page: &[u8; HEADER_BYTES]) -> u32 {
    let mut hasher = HASHER.clone();
    hasher.update(&page[..CRC_AT]);
    hasher.update(&page[IDENTITY_AT..RESERVED_AT]);
    hasher.finalize()
}

fn put(page: &mut [u8; HEADER_BYTES], at: usize, bytes: &[u8]) {
    page[at..at + bytes.len()].copy_from_slice(bytes);
}

fn field<const N: usize>(page: &[u8; HEADER_BYTES], at: usize) -> [u8; N] {
    let mut out = [0; N];
    out.copy_from_slice(&page[at..at + N]);
    out
}
