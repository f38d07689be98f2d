//! The bytes of a datagram between two nodes. spec: DATAGRAM-1
//!
//! ```text
//! offset size field
//!      0    1 version: 1
//!      1    1 contents: 1 an acknowledgement, 2 a value, 4 a probe
//!      2    2 length of the authentication tag at its end: 0 in this version
//!      4    4 node of the sender
//!      8    8 key, as the receiver has given it to the sender
//!     16    4 stamp: the sender's clock in microseconds, lower 32 bits
//!     20    4 CRC-32 (as in a frame) of the bytes before this, of the acknowledgement, and of a probe's number
//! an acknowledgement, 20 bytes and 12 for each range:
//!      0    4 stamp of the last received datagram
//!      4    4 microseconds since it was received
//!      8    8 values that were received by datagram and forwarded, so far
//!     16    1 count of ranges, 0 to 32
//!     17    3 0
//!   then 12 first received number (8), and how many follow it without a gap (4)
//! a value: one frame, to the end of the datagram
//! a probe, which is acknowledged at once: its number (8), then anything to the end of the datagram
//! ```

use sinew_runtime::tid::NodeAddress;

/// Maximum bytes of a datagram. Every network that carries IPv6 accepts 1,280 bytes including the headers of
/// IP and UDP (RFC 8200, section 5). QUIC sends 1,200 for that reason (RFC 9000, section 14): without
/// fragments, no fragment can be lost.
pub const DATAGRAM_MAX: usize = 1_200;
/// Bytes of the prefix.
pub(super) const PREFIX_LEN: usize = CRC_AT + 4;
/// Offset of the checksum.
const CRC_AT: usize = 20;
/// Bytes of an acknowledgement without ranges.
pub(super) const ACK_LEN: usize = 20;
/// Bytes of a range.
pub(super) const RANGE_LEN: usize = 12;
/// Maximum number of ranges in an acknowledgement.
pub(super) const RANGES_MAX: usize = 32;

const VERSION: u8 = 1;
const ACK: u8 = 1;
const VALUE: u8 = 2;
const PROBE: u8 = 4;

/// Consecutive numbers.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Range {
    pub(super) first: u64,
    pub(super) more: u32,
}

impl Range {
    pub(super) const fn of(number: u64) -> Self {
        Self { first: number, more: 0 }
    }

    pub(super) const fn has(self, number: u64) -> bool {
        matches!(number.checked_sub(self.first), Some(beyond) if beyond <= self.more as u64)
    }

    /// Returns the range including this number, if the number is in it or follows it directly.
    pub(super) fn with(self, number: u64) -> Option<Self> {
        match number.checked_sub(self.first)? {
            beyond if beyond <= self.more.into() => Some(self),
            beyond if beyond == u64::from(self.more) + 1 => {
                Some(Self { more: self.more.checked_add(1)?, ..self })
            }
            _ => None,
        }
    }
}

/// A receiver's report of received datagrams.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Acknowledgement {
    /// Stamp of the last received datagram.
    pub(super) echo: u32,
    /// Microseconds since its receipt.
    pub(super) held_us: u32,
    pub(super) taken: u64,
    pub(super) ranges: [Range; RANGES_MAX],
    pub(super) count: usize,
}

impl Acknowledgement {
    pub(super) fn ranges(&self) -> &[Range] {
        &self.ranges[..self.count]
    }

    const fn len(&self) -> usize {
        ACK_LEN + RANGE_LEN * self.count
    }
}

/// The prefix of a datagram.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Prefix {
    pub(crate) node: NodeAddress,
    pub(super) key: u64,
    pub(super) stamp: u32,
    what: u8,
}

/// The content of a datagram.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) struct Content<'a> {
    pub(super) acknowledgement: Option<Acknowledgement>,
    /// The number of a probe, which must be acknowledged at once.
    pub(super) probe: Option<u64>,
    pub(crate) value: Option<&'a [u8]>,
}

/// A datagram that is being encoded.
#[derive(Debug)]
pub(super) struct Packet {
    bytes: [u8; DATAGRAM_MAX],
    length: usize,
    /// Bytes before the value, which has its own checksum.
    head: usize,
}

impl Packet {
    pub(super) fn new(node: NodeAddress, key: u64, stamp: u32) -> Self {
        let mut packet = Self { bytes: [0; DATAGRAM_MAX], length: 0, head: PREFIX_LEN };
        packet.put(&[VERSION, 0, 0, 0]);
        packet.put(&node.bits().to_le_bytes());
        packet.put(&key.to_le_bytes());
        packet.put(&stamp.to_le_bytes());
        packet.put(&[0; 4]);
        packet
    }

    /// Returns the number of bytes so far.
    pub(super) const fn len(&self) -> usize {
        self.length
    }

    /// Appends a probe that pads the datagram to this length. Must be the last part. spec: DATAGRAM-7
    pub(super) fn probe(&mut self, number: u64, length: usize) {
        self.bytes[1] |= PROBE;
        self.put(&number.to_le_bytes());
        self.head = self.length;
        self.length = length.clamp(self.length, DATAGRAM_MAX);
    }

    /// Appends an acknowledgement. Must precede a value.
    pub(super) fn acknowledge(&mut self, acknowledgement: &Acknowledgement) {
        debug_assert!(
            acknowledgement.len() <= DATAGRAM_MAX - self.length,
            "it was made for the room that there is"
        );
        self.bytes[1] |= ACK;
        self.put(&acknowledgement.echo.to_le_bytes());
        self.put(&acknowledgement.held_us.to_le_bytes());
        self.put(&acknowledgement.taken.to_le_bytes());
        self.put(&[acknowledgement.count as u8, 0, 0, 0]);
        for range in acknowledgement.ranges() {
            self.put(&range.first.to_le_bytes());
            self.put(&range.more.to_le_bytes());
        }
        self.head = self.length;
    }

    /// Appends a frame in two parts. Must be the last part.
    pub(super) fn value(&mut self, header: &[u8], payload: &[u8]) {
        self.bytes[1] |= VALUE;
        self.put(header);
        self.put(payload);
    }

    /// Returns the whole datagram, with its checksum.
    pub(super) fn bytes(&mut self) -> &[u8] {
        let sum = checksum(&self.bytes[..self.head]);
        self.bytes[CRC_AT..PREFIX_LEN].copy_from_slice(&sum.to_le_bytes());
        &self.bytes[..self.length]
    }

    fn put(&mut self, bytes: &[u8]) {
        let end = self.length + bytes.len();
        self.bytes[self.length..end].copy_from_slice(bytes);
        self.length = end;
    }
}

/// Returns the checksum of the bytes before a value, which contain at least a prefix.
fn checksum(head: &[u8]) -> u32 {
    let mut hasher = crc32fast::Hasher::new();
    hasher.update(&head[..CRC_AT]);
    hasher.update(&head[PREFIX_LEN..]);
    hasher.finalize()
}

fn u32_at(bytes: &[u8], at: usize) -> Option<u32> {
    bytes.get(at..)?.first_chunk().copied().map(u32::from_le_bytes)
}

fn u64_at(bytes: &[u8], at: usize) -> Option<u64> {
    bytes.get(at..)?.first_chunk().copied().map(u64::from_le_bytes)
}

impl Prefix {
    /// Decodes the prefix. `None`: this is no datagram of this protocol, or of another version.
    pub(crate) fn read(bytes: &[u8]) -> Option<Self> {
        let [VERSION, what, 0, 0, ..] = *bytes else { return None };
        let node = NodeAddress::new(u32_at(bytes, 4)?);
        Some(Self { node, key: u64_at(bytes, 8)?, stamp: u32_at(bytes, 16)?, what })
    }

    /// Decodes the content behind the prefix; `None` if it is malformed.
    pub(crate) fn content(self, bytes: &[u8]) -> Option<Content<'_>> {
        let rest = bytes.get(PREFIX_LEN..)?;
        let (acknowledgement, rest) = if self.what & ACK == 0 { (None, rest) } else { read_ack(rest)? };
        let (probe, rest) =
            if self.what & PROBE == 0 { (None, rest) } else { (Some(u64_at(rest, 0)?), &rest[8..]) };
        let head = bytes.get(..bytes.len() - rest.len())?;
        if u32_at(bytes, CRC_AT)? != checksum(head) {
            return None;
        }
        let is_known = self.what & !(ACK | VALUE | PROBE) == 0;
        let has_value = self.what & VALUE != 0;
        // The bytes behind a probe are padding.
        let is_whole = if probe.is_some() { !has_value } else { has_value || rest.is_empty() };
        (is_known && is_whole).then_some(Content { acknowledgement, probe, value: has_value.then_some(rest) })
    }
}

fn read_ack(bytes: &[u8]) -> Option<(Option<Acknowledgement>, &[u8])> {
    let [count, 0, 0, 0] = *bytes.get(16..)?.first_chunk()? else { return None };
    let count = usize::from(count);
    let mut ranges = [Range::of(0); RANGES_MAX];
    for (at, range) in ranges.get_mut(..count)?.iter_mut().enumerate() {
        let at = ACK_LEN + RANGE_LEN * at;
        *range = Range { first: u64_at(bytes, at)?, more: u32_at(bytes, at + 8)? };
    }
    let (echo, held_us, taken) = (u32_at(bytes, 0)?, u32_at(bytes, 4)?, u64_at(bytes, 8)?);
    let rest = bytes.get(ACK_LEN + RANGE_LEN * count..)?;
    Some((Some(Acknowledgement { echo, held_us, taken, ranges, count }), rest))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn acknowledgement(numbers: &[(u64, u32)]) -> Acknowledgement {
        let mut ranges = [Range::of(0); RANGES_MAX];
        for (range, (first, more)) in ranges.iter_mut().zip(numbers) {
            *range = Range { first: *first, more: *more };
        }
        Acknowledgement { echo: 5, held_us: 250, taken: 41, ranges, count: numbers.len() }
    }

    #[test]
    fn documentation_shows_the_bytes_of_a_datagram() {
        let mut packet = Packet::new(NodeAddress::new(0x0a00_0007), 0x0807_0605_0403_0201, 1_000);
        packet.acknowledge(&acknowledgement(&[(7, 2)]));
        packet.value(b"Sw", b"...");
        let page = include_str!("../../../../docs/protocol/gncl.md");
        let shown = page.split("```datagram").nth(1).and_then(|rest| rest.split("```").next()).unwrap();
        let shown: Vec<_> = shown
            .lines()
            .flat_map(|line| line.trim_start().split("  ").next().unwrap_or_default().split_whitespace())
            .map(|byte| u8::from_str_radix(byte, 16).expect("two digits"))
            .collect();
        let (head, value) = packet.bytes().split_last_chunk::<5>().unwrap();
        assert_eq!(shown, head);
        assert_eq!(value, b"Sw...");
    }

    proptest! {
        #[test]
        fn encoded_datagrams_decode_to_the_same(
            ranges in proptest::option::of(proptest::collection::vec((any::<u64>(), any::<u32>()), 0..=RANGES_MAX)),
            value in proptest::option::of(proptest::collection::vec(any::<u8>(), 0..500)),
            probe in proptest::option::of((any::<u64>(), 0..=DATAGRAM_MAX)),
        ) {
            let value = value.filter(|_| probe.is_none());
            let mut packet = Packet::new(NodeAddress::new(3), 7, 9);
            let acknowledgement = ranges.map(|ranges| acknowledgement(&ranges));
            acknowledgement.iter().for_each(|acknowledgement| packet.acknowledge(acknowledgement));
            probe.iter().for_each(|(number, length)| packet.probe(*number, *length));
            value.iter().for_each(|value| packet.value(&value[..value.len() / 2], &value[value.len() / 2..]));
            let bytes = packet.bytes();
            let prefix = Prefix::read(bytes).unwrap();
            prop_assert_eq!((prefix.node, prefix.key, prefix.stamp), (NodeAddress::new(3), 7, 9));
            prop_assert!(probe.is_none_or(|(_, length)| bytes.len() >= length));
            let probe = probe.map(|(number, _)| number);
            let content = Content { acknowledgement, probe, value: value.as_deref() };
            prop_assert_eq!(prefix.content(bytes), Some(content));
        }

        #[test]
        fn damage_before_the_value_is_detected(at in 0..PREFIX_LEN + ACK_LEN + RANGE_LEN, bit in 0..8) {
            let mut packet = Packet::new(NodeAddress::new(3), 7, 9);
            packet.acknowledge(&acknowledgement(&[(7, 2)]));
            packet.value(b"a", b"value");
            let mut bytes = packet.bytes().to_vec();
            bytes[at] ^= 1_u8 << bit;
            prop_assert_eq!(Prefix::read(&bytes).and_then(|prefix| prefix.content(&bytes)), None);
        }

        #[test]
        fn any_bytes_are_a_datagram_or_none(mut bytes: Vec<u8>, as_ours: bool) {
            if let Some(start) = bytes.first_chunk_mut::<4>().filter(|_| as_ours) {
                *start = [VERSION, start[1] & 7, 0, 0];
            }
            if let Some(content) = Prefix::read(&bytes).and_then(|prefix| prefix.content(&bytes)) {
                prop_assert!(content.acknowledgement.is_none_or(|ack| ack.ranges().len() <= RANGES_MAX));
            }
        }

        #[test]
        fn range_contains_exactly_its_numbers(first in any::<u64>(), more in 0..3u32, number in any::<u64>()) {
            let range = Range { first, more };
            for number in [number, first, first.wrapping_add(u64::from(more)), first.wrapping_add(u64::from(more) + 1)] {
                if let Some(wider) = range.with(number) {
                    prop_assert!(wider.has(number) && wider.has(first));
                } else {
                    prop_assert!(!range.has(number));
                }
            }
        }
    }
}
