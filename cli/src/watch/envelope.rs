//! The content of a protected payload's envelope, for display only (`docs/protocol/protected.md`).
//!
//! The checksum is not verified: it includes the flow's data ID, which is not sent. Only the receiver can verify that
//! the bytes are authentic and not too old.

use sinew::protection::OVERHEAD;

/// Bytes before the payload.
const HEAD: usize = 32;
/// Bytes behind it: the checksum.
const TAIL: usize = OVERHEAD - HEAD;
/// The only version that there is; flags and zeros follow it.
const VERSION: u32 = 1;

/// The content of an envelope.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Unsealed<'bytes> {
    /// The number of the message in its flow, as claimed, from 1.
    pub(super) counter: u64,
    pub(super) payload: &'bytes [u8],
}

/// Parses an envelope; `None` if these bytes are none. No MessagePack value is mistaken for one: its first byte would
/// be a complete value.
pub(super) fn unsealed(bytes: &[u8]) -> Option<Unsealed<'_>> {
    let (head, rest) = bytes.split_first_chunk::<HEAD>()?;
    let (payload, _checksum) = rest.split_last_chunk::<TAIL>()?;
    let word = |at: usize| head.get(at..at + 8).and_then(|word| word.try_into().ok()).map(u64::from_le_bytes);
    let (first, counter) = (word(0)?, word(8)?);
    // Version, flags and zeros are the lower half of the first word, the length is the upper one.
    let is_one = first == ((payload.len() as u64) << 32) | u64::from(VERSION);
    is_one.then_some(Unsealed { counter, payload })
}

#[cfg(test)]
mod tests {
    use sinew::{
        AppAddress, NodeAddress, Tid, Time,
        protection::{DataId, Stamp, seal},
    };

    use super::*;

    /// Sealed by the library, so that the layout here cannot differ from it.
    fn sealed(payload: &[u8]) -> Vec<u8> {
        let tid = |app| Tid::new(NodeAddress::from([10, 0, 0, 1]), AppAddress::new(app));
        let data_id = DataId { source: tid(0x1001), destination: tid(0x1002), name: "demo.angle" };
        let stamp = Stamp { counter: 103, incarnation: 7, echo: Time::from_nanos(5) };
        seal(&data_id, stamp, payload).to_vec()
    }

    #[test]
    fn sealed_message_is_shown_with_its_counter() {
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
