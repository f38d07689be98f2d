//! The reading half of a unix connection: frames out of bytes.

use std::io;

use bytes::BytesMut;
use rustix::{
    io::Errno,
    net::{RecvFlags, recv},
};
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
        self.codec.set_payload_max(payload_max);
    }

    /// The next frame that is there already; `None` if there is none and none will come, the process at the other end
    /// being dead.
    pub(crate) fn next_of_the_dead(&mut self, stream: &UnixStream) -> Result<Option<Message>, FrameError> {
        let mut chunk = [0; READ_CHUNK];
        loop {
            if let Some(message) = self.codec.decode(&mut self.buffer)? {
                return Ok(Some(message));
            }
            match recv(stream, &mut chunk[..], RecvFlags::DONTWAIT) {
                // A reset says that it died with words of ours unread. It comes after its last words.
                Ok((_, 0)) | Err(Errno::AGAIN | Errno::CONNRESET) => return Ok(None),
                Ok((_, count)) => self.buffer.extend_from_slice(&chunk[..count]),
                Err(Errno::INTR) => {}
                Err(error) => return Err(io::Error::from(error).into()),
            }
        }
    }

    /// The next frame; `None` when the peer has closed. May be dropped at any time without losing a byte.
    pub(crate) async fn next(&mut self, stream: &UnixStream) -> Result<Option<Message>, FrameError> {
        loop {
            if let Some(message) = self.codec.decode(&mut self.buffer)? {
                return Ok(Some(message));
            }
            stream.readable().await?;
            // A long buffer is one that the codec has made for the frame that is coming, and is filled to its end.
            if self.buffer.capacity() <= FrameCodec::BUFFER_KEPT
                || self.buffer.len() == self.buffer.capacity()
            {
                self.buffer.reserve(READ_CHUNK);
            }
            match stream.try_read_buf(&mut self.buffer) {
                Ok(0) => return Ok(None),
                Ok(_) => {}
                Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
                Err(error) => return Err(error.into()),
            }
        }
    }
}
