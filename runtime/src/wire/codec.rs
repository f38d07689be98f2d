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
        "a payload of {said} bytes is above this node's limit of {limit}; raise `node.payload_max` on both sides"
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

/// A frame of at least so many bytes that is alone in its buffer takes the buffer along; of others the payload is copied.
const TAKES_ITS_BUFFER: usize = 8 * 1024;
/// A longer buffer that nothing is left in is given back.
const BUFFER_KEPT: usize = 256 * 1024;

/// Cuts a byte stream into messages and writes messages to one.
///
/// The length in a header is checked before memory is reserved for it. A payload holds its own bytes in memory and little
/// more: no message that waits long keeps the buffer that it came in.
#[derive(Clone, Copy, Debug)]
pub struct FrameCodec {
    payload_max: usize,
    checksum: Checksum,
    /// The most that the present buffer was seen to hold room for: what is cut off from its front does not show any more.
    largest: usize,
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
        Self { payload_max, checksum: Checksum::Crc, largest: 0 }
    }

    /// A codec for frames that stay in memory: without checksums.
    #[must_use]
    pub const fn in_memory(payload_max: usize) -> Self {
        Self { payload_max, checksum: Checksum::None, largest: 0 }
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
            self.make_room(source, whole);
            return Ok(None);
        }
        let frame = &source[..whole];
        let head = frame.first_chunk::<HEADER_LEN>().ok_or(HeaderError::NotAFrame)?;
        let header = self.checksum.decode(head, &frame[HEADER_LEN..])?;
        Ok(Some(Message::new(header, self.take_payload(source, whole))))
    }
}

impl FrameCodec {
    /// Sees to it that the rest of a frame of `whole` bytes has room: in a buffer of just that length, if it needs a new one.
    fn make_room(&mut self, source: &mut BytesMut, whole: usize) {
        if source.capacity() < whole {
            let mut own = BytesMut::with_capacity(whole);
            own.put_slice(source);
            *source = own;
            self.largest = 0;
        }
    }

    /// Begins at the front of an empty buffer again, or gives a long one back.
    fn reuse(&mut self, source: &mut BytesMut) {
        // Nothing else holds it, so that all of its length can be had again.
        if self.largest > BUFFER_KEPT || !source.try_reclaim(self.largest) {
            *source = BytesMut::new();
        }
        self.largest = 0;
    }

    /// The payload of the first frame of `source`, which has `whole` bytes.
    fn take_payload(&mut self, source: &mut BytesMut, whole: usize) -> Bytes {
        self.largest = self.largest.max(source.capacity());
        if source.len() == whole && whole >= TAKES_ITS_BUFFER && whole >= self.largest / 4 {
            self.largest = 0;
            let mut frame = std::mem::take(source).freeze();
            frame.advance(HEADER_LEN);
            return frame;
        }
        let payload = Bytes::copy_from_slice(&source[HEADER_LEN..whole]);
        source.advance(whole);
        if source.is_empty() {
            self.reuse(source);
        }
        payload
    }
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
    fn a_short_message_does_not_keep_the_buffer_that_it_came_in_and_a_long_one_takes_it_along() {
        let (mut codec, mut buffer) = (FrameCodec::new(1 << 20), BytesMut::with_capacity(1 << 20));
        buffer.extend_from_slice(&frame(&[1; 10]));
        buffer.extend_from_slice(&frame(&[2; 100_000]));
        let start = buffer.as_ptr() as usize;
        let mut next = || codec.decode(&mut buffer).unwrap().expect("a whole frame").payload;
        let (short, long) = (next(), next());
        for payload in [short, long] {
            let at = payload.as_ptr() as usize;
            assert!(!(start..start + (1 << 20)).contains(&at), "{} bytes keep a MiB", payload.len());
        }
        let whole = frame(&[3; 100_000]);
        for piece in whole.chunks(30_000) {
            assert!(codec.decode(&mut buffer).unwrap().is_none());
            buffer.extend_from_slice(piece);
        }
        let start = buffer.as_ptr() as usize;
        let long = codec.decode(&mut buffer).unwrap().expect("a whole frame").payload;
        assert_eq!(long.as_ptr() as usize, start + HEADER_LEN, "it is not copied");
        assert_eq!(buffer.capacity(), 0);
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
