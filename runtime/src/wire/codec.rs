//! Frames on a byte stream and in datagrams.

use bytes::{Buf, BufMut, Bytes, BytesMut};
use tokio_util::codec::{Decoder, Encoder};

use crate::wire::{HEADER_LEN, Header, HeaderError, Message, long, memory};

/// The reason why a stream of frames cannot continue. The connection is unusable after it.
#[derive(Debug, thiserror::Error)]
pub enum FrameError {
    /// An invalid header.
    #[error(transparent)]
    Header(#[from] HeaderError),
    /// The frame is longer than this node accepts.
    #[error(
        "a payload of {length} bytes is above this node's limit of {limit}; raise `node.payload_max` on both sides"
    )]
    TooLong {
        /// The length in the header.
        length: usize,
        /// The limit in force.
        limit: usize,
    },
    /// The connection failed.
    #[error(transparent)]
    Io(#[from] std::io::Error),
}

/// Frames below this length have their payloads copied out of the receive buffer.
const COPIED_BELOW: usize = 8 * 1024;

/// Cuts a byte stream into messages and writes messages to one.
///
/// The length in a header is checked before memory is reserved for it. A payload keeps its own bytes in
/// memory and little more: a message that waits long does not keep its receive buffer. A short one is copied
/// to one of the reading thread's reusable buffers.
#[derive(Clone, Copy, Debug)]
pub struct FrameCodec {
    payload_max: usize,
    checksum: Checksum,
    /// The end of the current buffer, by which it is recognised.
    end: usize,
    /// The largest observed capacity: bytes cut off from the front no longer count in the current one.
    largest: usize,
}

/// The kind of a frame's last four header bytes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Checksum {
    /// The CRC-32 of header and payload, for bytes on a wire.
    Crc,
    /// The same, and the length has its own guard, which is checked before the rest is awaited.
    Guarded,
    /// Zero, and not checked: the bytes stayed in memory.
    None,
}

impl Checksum {
    /// Returns the first 64 bytes of a frame.
    #[must_use]
    #[inline]
    pub fn encode(self, header: &Header, payload: &[u8]) -> [u8; HEADER_LEN] {
        match self {
            Self::Crc => header.encode(payload),
            Self::Guarded => header.encode_guarded(payload),
            Self::None => header.encode_in_memory(payload.len()),
        }
    }

    #[inline]
    fn decode(self, bytes: &[u8; HEADER_LEN], payload: &[u8]) -> Result<Header, HeaderError> {
        match self {
            Self::Crc => Header::decode(bytes, payload),
            Self::Guarded => Header::decode_guarded(bytes, payload),
            Self::None => Header::decode_in_memory(bytes),
        }
    }
}

impl FrameCodec {
    /// Creates a codec for payloads of at most `payload_max` bytes.
    #[must_use]
    pub const fn new(payload_max: usize) -> Self {
        Self { payload_max, checksum: Checksum::Crc, end: 0, largest: 0 }
    }

    /// Sets the maximum payload to `payload_max` bytes from now on.
    pub const fn set_payload_max(&mut self, payload_max: usize) {
        self.payload_max = payload_max;
    }

    /// Sets the checksum of frames from now on.
    pub const fn set_checksum(&mut self, checksum: Checksum) {
        self.checksum = checksum;
    }

    /// Creates a codec for frames that stay in memory: without checksums.
    #[must_use]
    pub const fn in_memory(payload_max: usize) -> Self {
        Self { payload_max, checksum: Checksum::None, end: 0, largest: 0 }
    }

    /// Returns the message of a frame that stays in memory and lies outside this process's own: its header, the
    /// number of bytes that follow it, and a function that copies these. `None` if they are not exactly its payload.
    ///
    /// # Errors
    /// The header is invalid, or the payload is too long.
    #[inline]
    pub fn decode_record(
        &self,
        head: &[u8; HEADER_LEN],
        following: usize,
        copy: impl FnOnce(&mut [u8]),
    ) -> Result<Option<Message>, FrameError> {
        let start = head.first_chunk().ok_or(HeaderError::NotAFrame)?;
        let length = Header::payload_len(start)? as usize;
        if length > self.payload_max {
            return Err(FrameError::TooLong { length, limit: self.payload_max });
        }
        if length != following {
            return Ok(None);
        }
        let header = Header::decode_in_memory(head)?;
        Ok(Some(Message::new(header, memory::filled(length, copy))))
    }
}

impl Decoder for FrameCodec {
    type Item = Message;
    type Error = FrameError;

    fn decode(&mut self, source: &mut BytesMut) -> Result<Option<Message>, FrameError> {
        let Some(start) = source.first_chunk::<8>() else { return Ok(None) };
        let declared = Header::payload_len(start)?;
        let length = declared as usize;
        if length > self.payload_max {
            return Err(FrameError::TooLong { length, limit: self.payload_max });
        }
        self.watch(source);
        if self.checksum == Checksum::Guarded {
            match source.first_chunk::<HEADER_LEN>() {
                Some(head) => Header::check_guard_of(head, declared)?,
                None => {
                    // The length is not trusted yet.
                    self.make_room(source, HEADER_LEN);
                    return Ok(None);
                }
            }
        }
        let whole = HEADER_LEN + length;
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
    /// Maximum length of a buffer that is kept. A longer frame has a buffer of its own, which the payload
    /// keeps; a longer empty buffer is freed.
    pub const BUFFER_KEPT: usize = 256 * 1024;

    /// Returns how much to read next at the end of `buffer`, at most `most` bytes. A buffer longer than
    /// [`BUFFER_KEPT`](Self::BUFFER_KEPT) was created for the current frame, and is filled to its end only.
    /// With later bytes it would grow, and each payload in it would keep all of it.
    #[must_use]
    pub fn room(buffer: &BytesMut, most: usize) -> usize {
        match buffer.capacity() - buffer.len() {
            left @ 1.. if buffer.capacity() > Self::BUFFER_KEPT => left.min(most),
            _ => most,
        }
    }

    /// Records the size of the allocation that payloads would keep.
    fn watch(&mut self, source: &BytesMut) {
        let end = source.as_ptr().addr() + source.capacity();
        self.largest = if end == self.end { self.largest.max(source.capacity()) } else { source.capacity() };
        self.end = end;
    }

    /// Ensures that the rest of a frame of `whole` bytes has room.
    fn make_room(&self, source: &mut BytesMut, whole: usize) {
        if whole <= Self::BUFFER_KEPT {
            // If the previous buffer is no longer used its memory is reused.
            source.reserve(whole - source.len());
        } else if source.capacity() < whole {
            let mut own = long::with_room(whole);
            own.put_slice(source);
            *source = own;
        }
    }

    /// Splits off the payload of the first frame of `source`, which has `whole` bytes.
    fn take_payload(&self, source: &mut BytesMut, whole: usize) -> Bytes {
        // The payload may wait for long, and must not keep much more than itself.
        let fills_its_buffer = whole >= COPIED_BELOW && whole >= self.largest / 4;
        if fills_its_buffer && (whole <= Self::BUFFER_KEPT || whole == source.len()) {
            let mut frame = source.split_to(whole).freeze();
            frame.advance(HEADER_LEN);
            self.tidy(source);
            return frame;
        }
        let payload = memory::copied(&source[HEADER_LEN..whole]);
        if whole == source.len() {
            // Most frames are the whole buffer: it keeps its front, which an advance would have to reclaim.
            source.clear();
        } else {
            source.advance(whole);
        }
        self.tidy(source);
        payload
    }

    /// Frees a long buffer that has become empty. Resets a shorter one to its front, if no payload keeps it.
    fn tidy(&self, source: &mut BytesMut) {
        if !source.is_empty() {
            return;
        }
        if self.largest > 2 * Self::BUFFER_KEPT {
            *source = BytesMut::new();
        } else {
            // If a payload keeps it, this is tried again when room is needed.
            let _ = source.try_reclaim(self.largest);
        }
    }
}

impl Encoder<&Message> for FrameCodec {
    type Error = FrameError;

    fn encode(&mut self, message: &Message, target: &mut BytesMut) -> Result<(), FrameError> {
        let length = message.payload.len();
        if length > self.payload_max {
            return Err(FrameError::TooLong { length, limit: self.payload_max });
        }
        target.reserve(HEADER_LEN + length);
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

/// Decodes a datagram, which must be exactly one frame. A short payload is copied to one of the reading
/// thread's reusable buffers, as in [`FrameCodec`].
///
/// # Errors
/// The fault in the bytes.
pub fn decode_datagram(bytes: &[u8]) -> Result<Message, HeaderError> {
    let Some(start) = bytes.first_chunk::<HEADER_LEN>() else { return Err(HeaderError::NotAFrame) };
    let payload = &bytes[HEADER_LEN..];
    // The header is checked against the payload before a byte of it is copied.
    let header = Header::decode(start, payload)?;
    Ok(Message::new(header, memory::copied(payload)))
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
        fn frames_in_memory_are_read_without_a_checksum(payload: Vec<u8>, noise: Vec<u8>) {
            let mut codec = FrameCodec::in_memory(1 << 20);
            let (mut buffer, header) = (BytesMut::new(), Header::new(Kind::named("test"), Tid::NONE, Tid::BROADCAST));
            codec.encode(&Message::new(header, payload.clone().into()), &mut buffer).unwrap();
            prop_assert_eq!(&buffer[60..64], &[0; 4]);
            prop_assert_eq!(codec.decode(&mut buffer).unwrap().expect("a whole frame").payload.to_vec(), payload);
            let _ = codec.decode(&mut BytesMut::from(noise.as_slice()));
        }

        #[test]
        fn garbage_is_an_error_or_a_wait(bytes: Vec<u8>) {
            let mut buffer = BytesMut::from(bytes.as_slice());
            let _ = FrameCodec::new(1024).decode(&mut buffer);
            let _ = decode_datagram(&bytes);
        }

        #[test]
        fn truncated_datagram_is_rejected(payload: Vec<u8>, keep in 0.0f64..1.0) {
            let whole = frame(&payload);
            let kept = (whole.len() as f64 * keep) as usize;
            prop_assert!(decode_datagram(&whole[..kept]).is_err());
        }
    }

    #[test]
    fn only_a_long_message_keeps_its_receive_buffer() {
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
        assert_eq!(buffer.capacity(), 0, "it is given back");
        for length in [20_000, 100_000, 500_000] {
            for piece in frame(&vec![3; length]).chunks(30_000) {
                assert!(codec.decode(&mut buffer).unwrap().is_none());
                buffer.extend_from_slice(piece);
            }
            let start = buffer.as_ptr() as usize;
            let long = codec.decode(&mut buffer).unwrap().expect("a whole frame").payload;
            assert_eq!(long.as_ptr() as usize, start + HEADER_LEN, "{length} bytes are not copied");
        }
    }

    #[test]
    fn datagram_payload_reuses_a_buffer_of_its_thread() {
        let datagrams = [frame(&[1; 100]), frame(&[2; 1_100])];
        let read = |at: usize| decode_datagram(&datagrams[at]).unwrap().payload;
        let place = memory::copied(b"something").as_ptr();
        assert_eq!([0, 1, 0].map(|at| read(at).as_ptr()), [place; 3]);
        // The newest value of a flow waits until its application receives it: others are elsewhere meanwhile.
        let (waits, next) = (read(0), read(1));
        assert_ne!(next.as_ptr(), place);
        assert_eq!((&waits[..], &next[..]), (&[1; 100][..], &[2; 1_100][..]));
    }

    #[test]
    fn freed_buffer_is_reused_and_kept_one_is_not() {
        let (mut codec, mut buffer) = (FrameCodec::new(1 << 20), BytesMut::new());
        let mut next = |value: u8| {
            buffer.extend_from_slice(&frame(&[value; 60_000]));
            codec.decode(&mut buffer).unwrap().expect("a whole frame").payload
        };
        let first = next(1);
        let at = first.as_ptr();
        drop(first);
        let second = next(2);
        assert_eq!(second.as_ptr(), at);
        let third = next(3);
        assert_ne!(third.as_ptr(), at);
        assert!(second.iter().all(|byte| *byte == 2) && third.iter().all(|byte| *byte == 3));
    }

    proptest! {
        // Each of them moves megabytes.
        #![proptest_config(ProptestConfig::with_cases(32))]

        #[test]
        fn payload_keeps_a_few_times_its_length_at_most(
            lengths in proptest::collection::vec(prop_oneof![0usize..200, 8_000usize..9_000, 20_000usize..700_000], 1..20),
            piece in 1_000usize..300_000,
        ) {
            let stream: Vec<u8> = lengths.iter().flat_map(|length| frame(&vec![7; *length]).to_vec()).collect();
            let (mut codec, mut buffer, mut waiting) = (FrameCodec::new(1 << 20), BytesMut::new(), Vec::new());
            let mut buffers = Vec::new();
            for piece in stream.chunks(piece) {
                buffer.extend_from_slice(piece);
                let held = buffer.as_ptr() as usize..buffer.as_ptr() as usize + buffer.capacity();
                while let Some(message) = codec.decode(&mut buffer).unwrap() {
                    let at = message.payload.as_ptr() as usize;
                    if held.contains(&at) {
                        buffers.push((message.payload.len(), held.len()));
                    }
                    waiting.push(message.payload);
                }
            }
            for (length, kept) in buffers {
                prop_assert!(length >= COPIED_BELOW - HEADER_LEN && kept <= 5 * length, "{length} bytes keep {kept}");
            }
            prop_assert_eq!(waiting.iter().map(Bytes::len).collect::<Vec<_>>(), lengths);
        }
    }

    #[test]
    fn oversized_length_is_rejected_before_memory_is_reserved() {
        let mut buffer = frame(&[]);
        buffer[4..8].copy_from_slice(&u32::MAX.to_le_bytes());
        let capacity = buffer.capacity();
        assert!(matches!(FrameCodec::new(1024).decode(&mut buffer), Err(FrameError::TooLong { .. })));
        assert_eq!(buffer.capacity(), capacity);
    }

    #[test]
    fn record_is_a_message_only_with_exactly_its_payload() {
        let codec = FrameCodec::in_memory(8);
        let head = Header::new(Kind::named("test"), Tid::NONE, Tid::NONE).encode_in_memory(4);
        let copy = |payload: &mut [u8]| payload.copy_from_slice(b"four");
        let message = codec.decode_record(&head, 4, copy).unwrap().expect("it is whole");
        assert_eq!(message.payload[..], b"four"[..]);
        for following in [0, 3, 5] {
            let never = |_: &mut [u8]| unreachable!("no memory is taken for it");
            assert!(codec.decode_record(&head, following, never).unwrap().is_none());
        }
        let long = Header::new(Kind::named("test"), Tid::NONE, Tid::NONE).encode_in_memory(9);
        let refused = codec.decode_record(&long, 9, |_| unreachable!("as above"));
        assert!(matches!(refused, Err(FrameError::TooLong { length: 9, limit: 8 })));
    }

    /// The example at the end of `docs/protocol/frame.md`.
    #[test]
    fn documented_frame_is_written_exactly() {
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

    #[test]
    fn damaged_length_is_rejected_once_its_guard_arrives() {
        let mut codec = FrameCodec::new(1 << 20);
        codec.set_checksum(Checksum::Guarded);
        let header = Header::new(Kind::OUTCOME, Tid::NONE, Tid::NONE);
        let mut bytes = Checksum::Guarded.encode(&header, b"four");
        let mut sound = BytesMut::from(&bytes[..]);
        sound.put_slice(b"four");
        assert_eq!(codec.decode(&mut sound).unwrap().expect("it is whole").payload[..], b"four"[..]);
        // 4 bytes become 512 KiB and 4.
        bytes[6] ^= 8;
        let mut source = BytesMut::from(&bytes[..40]);
        assert!(matches!(codec.decode(&mut source), Ok(None)));
        assert!(source.capacity() < 1_024, "{}", source.capacity());
        source.put_slice(&bytes[40..]);
        assert!(matches!(codec.decode(&mut source), Err(FrameError::Header(HeaderError::Guard))));
    }
}
