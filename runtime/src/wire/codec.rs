//! Frames on a byte stream and in datagrams.

use bytes::{Buf, BufMut, Bytes, BytesMut};
use tokio_util::codec::{Decoder, Encoder};

use crate::wire::{HEADER_LEN, Header, HeaderError, Message};

/// Why a stream of frames cannot go on. The connection is of no use after it.
#[derive(Debug, thiserror::Error)]
pub enum FrameError {
    /// A header that cannot be used.
    #[error(transparent)]
    Header(#[from] HeaderError),
    /// The frame is longer than this node takes.
    #[error(
        "a payload of {said} bytes is above this node's limit of {limit}; raise `max_payload_bytes` on both sides"
    )]
    TooLong {
        /// Length in the header.
        said: usize,
        /// The limit in force.
        limit: usize,
    },
    /// The connection failed.
    #[error(transparent)]
    Io(#[from] std::io::Error),
}

/// Cuts a byte stream into messages and writes messages to one.
///
/// The length in a header is checked before memory is reserved for it.
#[derive(Clone, Copy, Debug)]
pub struct FrameCodec {
    payload_max: usize,
    checksum: Checksum,
}

/// What a frame's last four header bytes are.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Checksum {
    /// The CRC-32 of header and payload: the bytes went over a wire.
    Crc,
    /// Zero, and not looked at: the bytes stayed in memory.
    None,
}

impl Checksum {
    /// The first 64 bytes of a frame.
    #[must_use]
    pub fn encode(self, header: &Header, payload: &[u8]) -> [u8; HEADER_LEN] {
        match self {
            Self::Crc => header.encode(payload),
            Self::None => header.encode_in_memory(payload.len()),
        }
    }

    fn decode(self, bytes: &[u8; HEADER_LEN], payload: &[u8]) -> Result<Header, HeaderError> {
        match self {
            Self::Crc => Header::decode(bytes, payload),
            Self::None => Header::decode_in_memory(bytes),
        }
    }
}

impl FrameCodec {
    /// A codec that takes payloads of at most `payload_max` bytes.
    #[must_use]
    pub const fn new(payload_max: usize) -> Self {
        Self { payload_max, checksum: Checksum::Crc }
    }

    /// A codec for frames that stay in memory: without checksums.
    #[must_use]
    pub const fn in_memory(payload_max: usize) -> Self {
        Self { payload_max, checksum: Checksum::None }
    }
}

impl Decoder for FrameCodec {
    type Item = Message;
    type Error = FrameError;

    fn decode(&mut self, source: &mut BytesMut) -> Result<Option<Message>, FrameError> {
        let Some(start) = source.first_chunk::<8>() else { return Ok(None) };
        let said = Header::payload_len(start)? as usize;
        if said > self.payload_max {
            return Err(FrameError::TooLong { said, limit: self.payload_max });
        }
        let whole = HEADER_LEN + said;
        if source.len() < whole {
            source.reserve(whole - source.len());
            return Ok(None);
        }
        Ok(Some(split(source.split_to(whole).freeze(), self.checksum)?))
    }
}

/// Reads the frame that fills `frame` to its last byte.
fn split(mut frame: Bytes, checksum: Checksum) -> Result<Message, HeaderError> {
    let Some(bytes) = frame.first_chunk::<HEADER_LEN>().copied() else {
        return Err(HeaderError::NotAFrame);
    };
    frame.advance(HEADER_LEN);
    Ok(Message::new(checksum.decode(&bytes, &frame)?, frame))
}

impl Encoder<&Message> for FrameCodec {
    type Error = FrameError;

    fn encode(&mut self, message: &Message, target: &mut BytesMut) -> Result<(), FrameError> {
        let said = message.payload.len();
        if said > self.payload_max {
            return Err(FrameError::TooLong { said, limit: self.payload_max });
        }
        target.reserve(HEADER_LEN + said);
        target.put_slice(&self.checksum.encode(&message.header, &message.payload));
        target.put_slice(&message.payload);
        Ok(())
    }
}

/// Appends one frame to `target`.
pub fn encode_frame(header: &Header, payload: &[u8], target: &mut BytesMut) {
    target.put_slice(&header.encode(payload));
    target.put_slice(payload);
}

/// Reads a datagram, which must be exactly one frame.
///
/// # Errors
/// What is wrong with the bytes.
pub fn decode_datagram(bytes: &[u8]) -> Result<Message, HeaderError> {
    let Some(start) = bytes.first_chunk::<HEADER_LEN>() else { return Err(HeaderError::NotAFrame) };
    let payload = &bytes[HEADER_LEN..];
    // The header is checked against the payload before a byte of it is copied.
    let header = Header::decode(start, payload)?;
    Ok(Message::new(header, Bytes::copy_from_slice(payload)))
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;
    use crate::{tid::Tid, wire::Kind};

    fn frame(payload: &[u8]) -> BytesMut {
        let mut bytes = BytesMut::new();
        encode_frame(&Header::new(Kind::named("test"), Tid::NONE, Tid::BROADCAST), payload, &mut bytes);
        bytes
    }

    proptest! {
        #[test]
        fn messages_survive_any_cutting_of_the_stream(
            payloads in proptest::collection::vec(proptest::collection::vec(any::<u8>(), 0..200), 1..8),
            cut in 1usize..97,
        ) {
            let stream: Vec<u8> = payloads.iter().flat_map(|payload| frame(payload).to_vec()).collect();
            let (mut codec, mut buffer, mut seen) = (FrameCodec::new(1024), BytesMut::new(), Vec::new());
            for piece in stream.chunks(cut) {
                buffer.extend_from_slice(piece);
                while let Some(message) = codec.decode(&mut buffer).unwrap() {
                    seen.push(message.payload.to_vec());
                }
            }
            prop_assert_eq!(seen, payloads);
        }

        #[test]
        fn frames_in_memory_are_read_without_a_checksum_and_garbage_is_no_panic(payload: Vec<u8>, noise: Vec<u8>) {
            let mut codec = FrameCodec::in_memory(1 << 20);
            let (mut buffer, header) = (BytesMut::new(), Header::new(Kind::named("test"), Tid::NONE, Tid::BROADCAST));
            codec.encode(&Message::new(header, payload.clone().into()), &mut buffer).unwrap();
            prop_assert_eq!(&buffer[60..64], &[0; 4]);
            prop_assert_eq!(codec.decode(&mut buffer).unwrap().expect("a whole frame").payload.to_vec(), payload);
            let _ = codec.decode(&mut BytesMut::from(noise.as_slice()));
        }

        #[test]
        fn garbage_is_an_error_or_a_wait_and_never_a_panic(bytes: Vec<u8>) {
            let mut buffer = BytesMut::from(bytes.as_slice());
            let _ = FrameCodec::new(1024).decode(&mut buffer);
            let _ = decode_datagram(&bytes);
        }

        #[test]
        fn a_truncated_datagram_is_refused(payload: Vec<u8>, keep in 0.0f64..1.0) {
            let whole = frame(&payload);
            let kept = (whole.len() as f64 * keep) as usize;
            prop_assert!(decode_datagram(&whole[..kept]).is_err());
        }
    }

    #[test]
    fn an_oversized_length_is_refused_before_memory_is_reserved() {
        let mut buffer = frame(&[]);
        buffer[4..8].copy_from_slice(&u32::MAX.to_le_bytes());
        let capacity = buffer.capacity();
        assert!(matches!(FrameCodec::new(1024).decode(&mut buffer), Err(FrameError::TooLong { .. })));
        assert_eq!(buffer.capacity(), capacity);
    }

    /// The example at the end of `docs/protocol/frame.md`.
    #[test]
    fn the_documented_frame_is_what_is_written() {
        let mut header = Header::new(
            Kind::named("demo.angle"),
            "10.0.0.7/1001".parse().unwrap(),
            "10.0.0.8/1002".parse().unwrap(),
        );
        (header.sequence, header.sent) = (1, crate::time::Time::from_nanos(1_000_000_000));
        let mut bytes = BytesMut::new();
        encode_frame(&header, b"\x81\xa7degrees\x01", &mut bytes);
        let hex: Vec<_> = bytes.iter().map(|byte| format!("{byte:02x}")).collect();
        let lines: Vec<_> = hex.chunks(16).map(|line| line.join(" ")).collect();
        let page = include_str!("../../../docs/protocol/frame.md");
        assert!(page.contains(&lines.join("\n")), "the page should show:\n{}", lines.join("\n"));
    }
}
