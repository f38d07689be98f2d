//! A message on a direct link, as a client reports it to its node for a watch; `docs/protocol/lncl.md` specifies the
//! bytes.

use bytes::{BufMut, Bytes, BytesMut};
use sinew_runtime::{
    tid::Tid,
    wire::{Class, HEADER_LEN, Header, Kind, Message},
};

use crate::payload;

/// Bytes before the message's header.
const PREFIX: usize = 16;
/// Longest payload that is reported, in bytes; of a longer one only its length is.
pub const OBSERVED_BYTES_MAX: usize = 16 * 1024;

/// The report of one message.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Observed {
    /// Whether the client sent the message; otherwise it received it.
    pub is_sent: bool,
    /// Messages that were not reported since the last report, because there was no room.
    pub missed: u32,
    /// The header of the message.
    pub header: Header,
    /// Bytes of the payload.
    pub length: u32,
    /// The payload; empty if it is longer than [`OBSERVED_BYTES_MAX`].
    pub payload: Bytes,
}

impl Observed {
    /// Returns the report of a message with this header and payload, of which nothing before was missed.
    pub fn of(header: &Header, payload: &[u8], is_sent: bool) -> Self {
        let shown = if payload.len() <= OBSERVED_BYTES_MAX { payload } else { &[] };
        let length = u32::try_from(payload.len()).unwrap_or(u32::MAX);
        Self { is_sent, missed: 0, header: *header, length, payload: Bytes::copy_from_slice(shown) }
    }

    /// Returns the frame from `source` to its LNCL.
    pub fn frame(&self, source: Tid) -> Message {
        let mut bytes = BytesMut::with_capacity(PREFIX + HEADER_LEN + self.payload.len());
        bytes.put_u32_le(u32::from(self.is_sent));
        bytes.put_u32_le(self.missed);
        bytes.put_u32_le(self.length);
        bytes.put_u32_le(0);
        bytes.put_slice(&self.header.encode_in_memory(self.payload.len()));
        bytes.put_slice(&self.payload);
        let mut header = Header::new(Kind::LNCL_OBSERVED, source, payload::lncl_of(source.node));
        header.class = Class::Bulk;
        Message::new(header, bytes.freeze())
    }

    /// Reads the payload of such a frame. Returns what is wrong with it otherwise.
    ///
    /// # Errors
    /// For display. The peer is at fault.
    pub fn read(bytes: &Bytes) -> Result<Self, String> {
        let Some((prefix, rest)) = bytes.split_first_chunk::<PREFIX>() else {
            return Err(format!("{} bytes are too few for a reported message", bytes.len()));
        };
        let Some((header, payload)) = rest.split_first_chunk::<HEADER_LEN>() else {
            return Err(format!("{} bytes are too few for a reported header", rest.len()));
        };
        let word = |index: usize| u32::from_le_bytes(std::array::from_fn(|at| prefix[4 * index + at]));
        let (direction, missed, length) = (word(0), word(1), word(2));
        let is_long = length as usize > OBSERVED_BYTES_MAX;
        if direction > 1 || word(3) != 0 || payload.len() != if is_long { 0 } else { length as usize } {
            return Err(format!(
                "a reported message of {length} bytes has {} bytes of payload",
                payload.len()
            ));
        }
        let header = Header::decode_in_memory(header).map_err(|cause| cause.to_string())?;
        let payload = bytes.slice(PREFIX + HEADER_LEN..);
        Ok(Self { is_sent: direction == 1, missed, header, length, payload })
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;
    use sinew_runtime::tid::{AppAddress, NodeAddress};

    use super::*;

    const NODE: NodeAddress = NodeAddress::new(0x7f00_0001);

    fn header() -> Header {
        let tid = |app| Tid::new(NODE, AppAddress::new(app));
        Header {
            class: Class::Stream,
            sequence: 7,
            ..Header::new(Kind::named("test.any"), tid(0x1001), tid(0x1002))
        }
    }

    #[test]
    fn long_payload_is_left_out_but_its_length_stays() {
        for (bytes, shown) in [(0, 0), (OBSERVED_BYTES_MAX, OBSERVED_BYTES_MAX), (OBSERVED_BYTES_MAX + 1, 0)]
        {
            let observed = Observed { missed: 3, ..Observed::of(&header(), &vec![1; bytes], true) };
            assert_eq!((observed.length as usize, observed.payload.len()), (bytes, shown));
            assert_eq!(Observed::read(&observed.frame(header().source).payload), Ok(observed));
        }
    }

    proptest! {
        #[test]
        fn any_bytes_are_read_or_refused(bytes in proptest::collection::vec(any::<u8>(), 0..200)) {
            if let Ok(observed) = Observed::read(&bytes.clone().into()) {
                prop_assert_eq!(observed.frame(header().source).payload.len(), bytes.len());
            }
        }
    }
}
