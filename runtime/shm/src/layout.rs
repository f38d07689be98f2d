//! The layout of a region. Both sides of a connection are built from the same layout or reject each other.
//!
//! ```text
//! byte 0     identity: magic, version, capacity        written once, before the region is offered
//! byte 128   tail                                       bytes ever published in this region's ring
//! byte 256   head                                       bytes ever taken from the peer's ring
//! byte 384   sleep of this side's consumer              odd while it sleeps
//! byte 512   sleep of this side's producer              odd while it sleeps
//! byte 640   rung                                       the peer's sleep for which this side has rung last
//! byte 768   reported                                   tail that this side has reported to the peer's wait set
//! byte 1024  counters                                   384 numbers of 64 bits for the peer to read, of any meaning
//! byte 4096  the ring: records of 8-byte multiples
//! ```
//!
//! The others are words of 32 bits that count up and wrap. Each has 128 bytes for itself: two cache lines, because
//! processors fetch the neighbour too. All words of a region have one writer: the side that created it.

use std::fmt;

use thiserror::Error;

/// "SINEWSHM", read as little-endian.
pub(crate) const MAGIC: u64 = u64::from_le_bytes(*b"SINEWSHM");
/// Changes whenever a byte changes its meaning.
pub(crate) const VERSION: u32 = 3;
/// Offset of the ring: after a page for the header.
pub(crate) const HEADER_BYTES: usize = 4096;
/// Offset of the counters.
pub(crate) const COUNTERS_AT: usize = 1024;
/// How many there are.
pub(crate) const COUNTERS: usize = 384;
/// A record begins with this, and is padded to a multiple of it.
pub(crate) const MARK_BYTES: u32 = 8;

/// A counting word of the header.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Word {
    /// Bytes ever published in the region's ring.
    Tail,
    /// Bytes ever consumed from the peer's ring.
    Head,
    /// Sleep of the region's consumer, which waits for messages.
    ConsumerSleep,
    /// Sleep of the region's producer, which waits for room.
    ProducerSleep,
    /// The sleep of the peer's consumer for which the region's producer has rung last. The consumer may sleep at it.
    Rung,
    /// Bytes published when the region's producer has set its bit in the peer's wait set last.
    Reported,
}

impl Word {
    /// Its index among the header's 32-bit words.
    pub(crate) const fn index(self) -> usize {
        match self {
            Self::Tail => 128 / 4,
            Self::Head => 256 / 4,
            Self::ConsumerSleep => 384 / 4,
            Self::ProducerSleep => 512 / 4,
            Self::Rung => 640 / 4,
            Self::Reported => 768 / 4,
        }
    }
}

/// Bytes of a ring: a power of two from 4 KiB to 1 GiB.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub struct Capacity(u32);

/// A number that cannot be a ring's capacity.
#[derive(Clone, Copy, Debug, PartialEq, Eq, Error)]
#[error("{0} bytes is not a ring's capacity: a power of two from 4096 to 1073741824 is")]
pub struct CapacityError(pub u64);

impl Capacity {
    /// The smallest: one page.
    pub const MIN: Self = Self(4096);
    /// The largest: 1 GiB.
    pub const MAX: Self = Self(1 << 30);

    /// Creates a capacity of `bytes` bytes.
    ///
    /// # Errors
    /// When `bytes` is not a power of two from 4 KiB to 1 GiB.
    pub fn new(bytes: u64) -> Result<Self, CapacityError> {
        match u32::try_from(bytes) {
            Ok(fits) if fits.is_power_of_two() && (Self::MIN.0..=Self::MAX.0).contains(&fits) => {
                Ok(Self(fits))
            }
            _ => Err(CapacityError(bytes)),
        }
    }

    /// Creates a ring so small that models see it wrap at once.
    #[cfg(test)]
    pub(crate) fn tiny(bytes: u32) -> Self {
        assert!(bytes.is_power_of_two() && bytes >= 2 * MARK_BYTES, "a ring holds two marks");
        Self(bytes)
    }

    /// Returns the number of bytes.
    #[must_use]
    pub const fn bytes(self) -> u32 {
        self.0
    }

    /// Returns the longest message, in bytes. Half the ring, so that it fits into an empty ring at any
    /// position.
    #[must_use]
    pub const fn payload_max(self) -> u32 {
        self.0 / 2 - MARK_BYTES
    }

    /// The position in the ring of a count of bytes.
    pub(crate) const fn position(self, count: u32) -> u32 {
        count & (self.0 - 1)
    }

    /// Bytes from a count to the end of the ring.
    pub(crate) const fn rest(self, count: u32) -> u32 {
        self.0 - self.position(count)
    }

    /// Bytes of the whole region.
    pub(crate) const fn region_bytes(self) -> u64 {
        HEADER_BYTES as u64 + self.0 as u64
    }
}

impl fmt::Display for Capacity {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{} bytes", self.0)
    }
}

/// The content of the first eight bytes of a record.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Mark {
    /// A message of this many bytes follows.
    Message(u32),
    /// Nothing until the ring begins again.
    Skip,
}

const MESSAGE: u32 = 0xDA7A_0001;
const SKIP: u32 = 0x5C1B_0002;

impl Mark {
    pub(crate) const fn to_bits(self) -> u64 {
        match self {
            Self::Message(length) => (MESSAGE as u64) << 32 | length as u64,
            Self::Skip => (SKIP as u64) << 32,
        }
    }

    /// Parses a mark. `None` when no valid producer writes such a mark.
    pub(crate) fn from_bits(bits: u64) -> Option<Self> {
        let length = bits as u32;
        match ((bits >> 32) as u32, length) {
            (MESSAGE, _) => Some(Self::Message(length)),
            (SKIP, 0) => Some(Self::Skip),
            _ => None,
        }
    }
}

/// Bytes of a record with a message of `length` bytes; `None` when that exceeds the range of counts.
pub(crate) fn record_bytes(length: u32) -> Option<u32> {
    length.checked_next_multiple_of(MARK_BYTES)?.checked_add(MARK_BYTES)
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn capacity_is_a_power_of_two_within_its_limits() {
        for bytes in [4096, 65_536, 1 << 30] {
            assert!(Capacity::new(bytes).is_ok(), "{bytes}");
        }
        for bytes in [0, 1, 2048, 4097, 6144, (1 << 30) + 1, 1 << 31, 1 << 32, 1 << 44, u64::MAX] {
            assert_eq!(Capacity::new(bytes), Err(CapacityError(bytes)));
        }
    }

    #[test]
    fn mark_round_trips_and_other_bits_are_none() {
        for mark in [Mark::Message(0), Mark::Message(u32::MAX), Mark::Skip] {
            assert_eq!(Mark::from_bits(mark.to_bits()), Some(mark));
        }
        for bits in [0, 1, u64::MAX, Mark::Skip.to_bits() | 8, Mark::Message(8).to_bits().swap_bytes()] {
            assert_eq!(Mark::from_bits(bits), None, "{bits:#x}");
        }
    }

    #[test]
    fn header_words_share_no_cache_line_pair() {
        let words =
            [Word::Tail, Word::Head, Word::ConsumerSleep, Word::ProducerSleep, Word::Rung, Word::Reported];
        let pairs: std::collections::BTreeSet<usize> =
            words.iter().map(|word| word.index() * 4 / 128).collect();
        assert_eq!(pairs.len(), words.len());
        assert!(!pairs.contains(&0), "the identity has its own");
        assert!(words.iter().all(|word| word.index() * 4 + 4 <= HEADER_BYTES));
    }

    #[test]
    fn record_near_the_counting_limit_is_none() {
        assert_eq!(record_bytes(0), Some(8));
        assert_eq!(record_bytes(1), Some(16));
        assert_eq!(record_bytes(u32::MAX), None);
        assert_eq!(record_bytes(u32::MAX - 7), None);
    }
}
