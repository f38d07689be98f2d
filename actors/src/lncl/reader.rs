//! The reading half of a unix connection: frames out of bytes.

use std::io;

use bytes::BytesMut;
use sinew_runtime::wire::{FrameCodec, FrameError, Message};
use tokio::net::UnixStream;
use tokio_util::codec::Decoder;

/// Bytes that are read at once.
const READ_CHUNK: usize = 16 * 1024;

/// The reading half of a connection.
pub(crate) struct Reader {
    buffer: BytesMut,
    codec: FrameCodec,
}

impl Reader {
    /// Takes payloads of at most `payload_max` bytes.
    pub(crate) fn new(payload_max: usize) -> Self {
        Self { buffer: BytesMut::new(), codec: FrameCodec::new(payload_max) }
    }

    /// Takes payloads of at most `payload_max` bytes from now on.
    pub(crate) fn set_payload_max(&mut self, payload_max: usize) {
        self.codec = FrameCodec::new(payload_max);
    }

    /// The next frame; `None` when the peer has closed. May be dropped at any time without losing a byte.
    pub(crate) async fn next(&mut self, stream: &UnixStream) -> Result<Option<Message>, FrameError> {
        loop {
            if let Some(message) = self.codec.decode(&mut self.buffer)? {
                return Ok(Some(message));
            }
            stream.readable().await?;
            self.buffer.reserve(READ_CHUNK);
            match stream.try_read_buf(&mut self.buffer) {
                Ok(0) => return Ok(None),
                Ok(_) => {}
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                Err(error) => return Err(error.into()),
            }
        }
    }
}
