//! The wire format of every connection and datagram: headers, and frames split into arbitrary pieces.

use bytes::BytesMut;
use sinew_runtime::{
    tid::Tid,
    wire::{Checksum, FrameCodec, HEADER_LEN, Header, Kind, MAGIC, VERSION, decode_datagram, encode_frame},
};
use tokio_util::codec::{Decoder as _, Encoder as _};

const PAYLOAD_MAX: usize = 4096;
/// Length of the part of a header that the checksum covers; the checksum itself follows it.
const CHECKED: usize = HEADER_LEN - 4;

fn frame(payload: &[u8]) -> BytesMut {
    let mut bytes = BytesMut::new();
    encode_frame(&Header::new(Kind::named("test"), Tid::NONE, Tid::BROADCAST), payload, &mut bytes);
    bytes
}

pub(crate) fn some_headers() -> Vec<Vec<u8>> {
    vec![frame(b"").to_vec(), frame(b"payload").to_vec()]
}

pub(crate) fn some_frames() -> Vec<Vec<u8>> {
    let pieces = |piece: u8| [&[piece][..], &frame(b"one"), &frame(&[2; 500]), &frame(b"")].concat();
    vec![pieces(0), pieces(255)]
}

/// One header and its payload. In each form it decodes to a message or an error, and encoding the result
/// yields the same bytes.
pub(crate) fn header(bytes: &[u8]) -> bool {
    let Some((head, payload)) = bytes.split_first_chunk::<HEADER_LEN>() else {
        assert!(decode_datagram(bytes).is_err(), "shorter than a header");
        return false;
    };
    if let Ok(header) = Header::decode(head, payload) {
        assert_eq!(header.encode(payload)[..CHECKED], head[..CHECKED]);
    }
    if let Ok(header) = Header::decode_guarded(head, payload) {
        assert_eq!(Header::decode_guarded(&header.encode_guarded(payload), payload).as_ref(), Ok(&header));
    }
    let _ = Header::check_guard(head);
    let _ = decode_datagram(bytes);
    // A fuzzer does not find a valid checksum by chance, so the rest runs as if it were valid.
    let mut head = *head;
    head[..4].copy_from_slice(&[MAGIC[0], MAGIC[1], VERSION, HEADER_LEN as u8]);
    head[4..8].copy_from_slice(&(payload.len() as u32).to_le_bytes());
    let Ok(header) = Header::decode_in_memory(&head) else { return false };
    assert_eq!(header.encode_in_memory(payload.len())[..CHECKED], head[..CHECKED]);
    let whole = [&header.encode(payload)[..], payload].concat();
    let read = decode_datagram(&whole).expect("its checksum is right");
    assert_eq!((read.header, &read.payload[..]), (header, payload));
    // Arithmetic on timestamps does not overflow for any value in the header.
    let _ = header.is_expired(header.expiry());
    true
}

/// Any bytes on a connection, split into any pieces. They decode to messages or an error. No frame exceeds
/// the limit, and no more memory is reserved than frames within the limit need. Encoding the result yields
/// the same bytes.
pub(crate) fn frames(bytes: &[u8]) -> bool {
    let Some((piece, bytes)) = bytes.split_first() else { return false };
    let (mut bytes, pieces) = (bytes.to_vec(), 1 + usize::from(*piece));
    let mut guarded = FrameCodec::new(PAYLOAD_MAX);
    guarded.set_checksum(Checksum::Guarded);
    // A reader without guard support does not encode the guard again, so this run only checks for panics.
    let _ = read_all(guarded, &bytes, pieces, false);
    read_all(FrameCodec::new(PAYLOAD_MAX), &bytes, pieces, true);
    // A fuzzer does not find a valid frame prefix or checksum by chance.
    mend(&mut bytes);
    read_all(FrameCodec::in_memory(PAYLOAD_MAX), &bytes, pieces, true);
    read_all(FrameCodec::new(PAYLOAD_MAX), &bytes, pieces, true) > 0
}

/// Gives each frame a valid prefix and checksum, and keeps only the lower 13 bits of each length.
fn mend(mut bytes: &mut [u8]) {
    while bytes.len() >= HEADER_LEN {
        bytes[..2].copy_from_slice(&MAGIC);
        bytes[2..4].copy_from_slice(&[VERSION, HEADER_LEN as u8]);
        bytes[5] &= 0x1F;
        bytes[6..8].fill(0);
        let start = bytes.first_chunk().expect("a header is longer");
        let length = Header::payload_len(start).expect("it was just made one") as usize;
        if bytes.len() < HEADER_LEN + length {
            return;
        }
        let (frame, rest) = bytes.split_at_mut(HEADER_LEN + length);
        let mut crc = crc32fast::Hasher::new();
        crc.update(&frame[..CHECKED]);
        crc.update(&frame[HEADER_LEN..]);
        frame[CHECKED..HEADER_LEN].copy_from_slice(&crc.finalize().to_le_bytes());
        bytes = rest;
    }
}

fn read_all(mut codec: FrameCodec, bytes: &[u8], pieces: usize, is_plain: bool) -> usize {
    let (mut buffer, mut read, mut messages) = (BytesMut::new(), 0, 0);
    for piece in bytes.chunks(pieces) {
        buffer.extend_from_slice(piece);
        loop {
            match codec.decode(&mut buffer) {
                Ok(Some(message)) => {
                    messages += 1;
                    assert!(message.payload.len() <= PAYLOAD_MAX);
                    let mut again = BytesMut::new();
                    codec.encode(&message, &mut again).expect("it was read within the limit");
                    let frame = &bytes[read..read + again.len()];
                    if is_plain {
                        assert_eq!(again[..CHECKED], frame[..CHECKED]);
                    }
                    assert_eq!(again[HEADER_LEN..], frame[HEADER_LEN..]);
                    read += again.len();
                }
                Ok(None) => break,
                Err(_) => return messages,
            }
        }
        assert!(buffer.capacity() <= 2 * FrameCodec::BUFFER_KEPT);
    }
    messages
}
