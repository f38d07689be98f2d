//! Any bytes on a connection, in any pieces: they are messages or an error, no frame is longer than the limit, no more memory
//! is reserved than frames within it need, and what was read is written back the same.

#![no_main]

use bytes::BytesMut;
use sinew_runtime::wire::{FrameCodec, HEADER_LEN, Header, MAGIC, VERSION};
use tokio_util::codec::{Decoder as _, Encoder as _};

const PAYLOAD_MAX: usize = 4096;
/// Of a header: all but its checksum, which stands behind.
const CHECKED: usize = HEADER_LEN - 4;

libfuzzer_sys::fuzz_target!(|bytes: &[u8]| {
    let Some((piece, bytes)) = bytes.split_first() else { return };
    let (mut bytes, pieces) = (bytes.to_vec(), 1 + usize::from(*piece));
    read_all(FrameCodec::new(PAYLOAD_MAX), &bytes, pieces);
    // No fuzzer guesses what a frame starts with, or a checksum.
    mend(&mut bytes);
    read_all(FrameCodec::in_memory(PAYLOAD_MAX), &bytes, pieces);
    read_all(FrameCodec::new(PAYLOAD_MAX), &bytes, pieces);
});

/// Each frame begins as frames do, and has its checksum; of lengths, the lower 13 bits are left.
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

fn read_all(mut codec: FrameCodec, bytes: &[u8], pieces: usize) {
    let (mut buffer, mut read) = (BytesMut::new(), 0);
    for piece in bytes.chunks(pieces) {
        buffer.extend_from_slice(piece);
        loop {
            match codec.decode(&mut buffer) {
                Ok(Some(message)) => {
                    assert!(message.payload.len() <= PAYLOAD_MAX);
                    let mut again = BytesMut::new();
                    codec.encode(&message, &mut again).expect("it was read within the limit");
                    let frame = &bytes[read..read + again.len()];
                    assert_eq!(again[..CHECKED], frame[..CHECKED]);
                    assert_eq!(again[HEADER_LEN..], frame[HEADER_LEN..]);
                    read += again.len();
                }
                Ok(None) => break,
                Err(_) => return,
            }
        }
        assert!(buffer.capacity() <= 2 * FrameCodec::BUFFER_KEPT);
    }
}
