//! The envelope of a protected payload.
//!
//! Little-endian: version (1 byte), flags (1, all zero), zero (2), length of the payload (4), counter (8),
//! incarnation (8), echo (8), payload, CRC-64 (8). The CRC is CRC-64/XZ (ECMA-182, reflected), as in
//! AUTOSAR's E2E profile 7; it is taken over the data ID, then all bytes before the CRC. The data ID itself
//! is not sent: a receiver that is not the addressee computes another one.

use bytes::{BufMut, Bytes, BytesMut};
use crc64fast::Digest;

use crate::{tid::Tid, time::Time, wire::Payload};

/// Length of the header before the payload, in bytes.
pub(super) const HEAD: usize = 32;
/// Length of the CRC after the payload, in bytes.
const TAIL: usize = 8;
/// Bytes that protection adds to a payload.
pub const OVERHEAD: usize = HEAD + TAIL;

const VERSION: u8 = 1;

/// The data ID of a flow of protected messages: source, destination and type. Both ends know it; it is not sent.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct DataId {
    /// The sender.
    pub source: Tid,
    /// The receiver. One application: a group has no data ID.
    pub destination: Tid,
    /// [`Payload::NAME`].
    pub name: &'static str,
}

impl DataId {
    /// Returns the data ID of values of type `P` from `source` to `destination`.
    #[must_use]
    pub const fn of<P: Payload>(source: Tid, destination: Tid) -> Self {
        Self { source, destination, name: P::NAME }
    }

    fn digest(&self) -> Digest {
        let mut digest = Digest::new();
        digest.write(&self.source.bits().to_le_bytes());
        digest.write(&self.destination.bits().to_le_bytes());
        digest.write(&(self.name.len() as u64).to_le_bytes());
        digest.write(self.name.as_bytes());
        digest
    }
}

/// The header fields that the sender sets for one message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Stamp {
    /// The counter of the messages of the flow, from 1.
    pub counter: u64,
    /// The incarnation of the sender that counts.
    pub incarnation: u64,
    /// The newest time of the receiver's clock that the sender has received from it; [`Time::ZERO`] for none.
    pub echo: Time,
}

/// Seals `payload` in an envelope.
#[must_use]
pub fn seal(data_id: &DataId, stamp: Stamp, payload: &[u8]) -> Bytes {
    let mut bytes = BytesMut::with_capacity(OVERHEAD + payload.len());
    bytes.put_u8(VERSION);
    bytes.put_bytes(0, 3);
    // A length above 32 bits is rejected by `payload_max`, which is smaller.
    bytes.put_u32_le(payload.len() as u32);
    bytes.put_u64_le(stamp.counter);
    bytes.put_u64_le(stamp.incarnation);
    bytes.put_u64_le(stamp.echo.as_nanos());
    bytes.extend_from_slice(payload);
    let mut digest = data_id.digest();
    digest.write(&bytes);
    bytes.put_u64_le(digest.sum64());
    bytes.freeze()
}

/// Opens an envelope and returns its payload. Returns `None` if the bytes are not those that were sealed
/// under this data ID.
#[must_use]
pub fn open(data_id: &DataId, bytes: &Bytes) -> Option<(Stamp, Bytes)> {
    look(data_id, bytes).map(|(stamp, payload)| (stamp, bytes.slice_ref(payload)))
}

/// Same as [`open`], for borrowed memory.
#[must_use]
pub fn look<'bytes>(data_id: &DataId, bytes: &'bytes [u8]) -> Option<(Stamp, &'bytes [u8])> {
    let (sealed, sum) = bytes.split_last_chunk::<TAIL>()?;
    let mut digest = data_id.digest();
    digest.write(sealed);
    if digest.sum64() != u64::from_le_bytes(*sum) {
        return None;
    }
    parse(sealed)
}

/// The content of an envelope that was not verified; see [`unsealed`].
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Unsealed<'bytes> {
    /// The number of the message in its flow, as claimed, from 1.
    pub counter: u64,
    /// The payload.
    pub payload: &'bytes [u8],
}

/// Parses an envelope without its data ID, for display and for recordings; `None` if these bytes are none.
///
/// The checksum is not verified: it includes the data ID, which is not sent. Only the receiver can verify that the
/// bytes are authentic and not too old. No MessagePack value is mistaken for an envelope: its first byte would be a
/// complete value.
///
/// # Examples
///
/// ```
/// use sinew::{Tid, Time, protection::{DataId, Stamp, seal, unsealed}};
///
/// let (hip, knee): (Tid, Tid) = ("10.0.0.1/1001".parse()?, "10.0.0.2/1001".parse()?);
/// let data_id = DataId { source: hip, destination: knee, name: "demo.angle" };
/// let sealed = seal(&data_id, Stamp { counter: 103, incarnation: 7, echo: Time::ZERO }, &[5]);
/// let shown = unsealed(&sealed).expect("it is an envelope");
/// assert_eq!((shown.counter, shown.payload), (103, &[5][..]));
/// assert_eq!(unsealed(&[5]), None);
/// # Ok::<(), Box<dyn std::error::Error>>(())
/// ```
#[must_use]
pub fn unsealed(bytes: &[u8]) -> Option<Unsealed<'_>> {
    let (sealed, _checksum) = bytes.split_last_chunk::<TAIL>()?;
    let (stamp, payload) = parse(sealed)?;
    Some(Unsealed { counter: stamp.counter, payload })
}

/// Parses an envelope without its checksum.
fn parse(sealed: &[u8]) -> Option<(Stamp, &[u8])> {
    let (head, payload) = sealed.split_first_chunk::<HEAD>()?;
    let word = |at: usize| head.get(at..at + 8).and_then(|word| word.try_into().ok()).map(u64::from_le_bytes);
    let (first, counter, incarnation, echo) = (word(0)?, word(8)?, word(16)?, word(24)?);
    // Version, flags and zeros are the lower half of the first word; the length is the upper half.
    let is_known = first as u32 == u32::from(VERSION);
    let is_whole = first >> 32 == payload.len() as u64;
    let stamp = Stamp { counter, incarnation, echo: Time::from_nanos(echo) };
    (is_known && is_whole).then_some((stamp, payload))
}

/// Returns the payload of a message that was checked and was good.
pub(super) fn payload_of(sealed: &[u8]) -> &[u8] {
    sealed.get(HEAD..sealed.len().saturating_sub(TAIL)).unwrap_or_default()
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::tid::{AppAddress, NodeAddress};

    /// The envelope of the message 103 of its flow.
    fn sealed(payload: &[u8]) -> Vec<u8> {
        let tid = |app| Tid::new(NodeAddress::from([10, 0, 0, 1]), AppAddress::new(app));
        let data_id = DataId { source: tid(0x1001), destination: tid(0x1002), name: "demo.angle" };
        let stamp = Stamp { counter: 103, incarnation: 7, echo: Time::from_nanos(5) };
        seal(&data_id, stamp, payload).to_vec()
    }

    #[test]
    fn sealed_payload_is_shown_with_its_counter() {
        for payload in [&b""[..], &[0x81, 0xa1, b'a', 1], &[7; 4_000]] {
            assert_eq!(unsealed(&sealed(payload)), Some(Unsealed { counter: 103, payload }));
        }
    }

    #[test]
    fn truncated_or_foreign_bytes_are_no_envelope() {
        let good = sealed(&[1, 2, 3]);
        for length in 0..good.len() {
            assert_eq!(unsealed(&good[..length]), None, "{length} bytes");
        }
        assert_eq!(unsealed(&[&good[..], &[0]].concat()), None);
        // Version, flags, zeros and length.
        for at in 0..8 {
            let mut other = good.clone();
            other[at] ^= 0x80;
            assert_eq!(unsealed(&other), None, "byte {at}");
        }
        for foreign in [vec![0; 100], vec![0xff; 100], vec![1; 100]] {
            assert_eq!(unsealed(&foreign), None);
        }
    }
}
