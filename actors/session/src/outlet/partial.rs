//! A frame that is being written to a socket.

use std::io::{self, IoSlice};

use sinew_runtime::wire::{Checksum, HEADER_LEN, Message};

use super::Socket;

/// A frame of which the socket has accepted the first bytes, or none yet.
pub(super) struct Partial {
    pub(super) message: Message,
    head: [u8; HEADER_LEN],
    pub(super) written: usize,
    pub(super) origin: FrameOrigin,
}

/// The origin of a frame.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum FrameOrigin {
    /// A sender's message, for the first time.
    Sender,
    /// A message that the session keeps, or a void in its place. It was counted when it was first written.
    Retransmission,
    /// A frame of the connection itself: the first, the last, or an urgent one. It belongs to this connection
    /// and to no sender.
    Link,
}

/// The result of a write.
pub(super) enum Written {
    Whole,
    /// One piece of the frame was written; the socket may accept more.
    Piece,
    /// The socket accepts no more now.
    InPart,
    Broken,
}

impl Partial {
    #[inline]
    pub(super) fn new(message: Message, checksum: Checksum, origin: FrameOrigin) -> Self {
        let head = checksum.encode(&message.header, &message.payload);
        Self { message, head, written: 0, origin }
    }

    /// Lets the socket gather the whole frame. Returns whether it did.
    pub(super) fn gather_in(&self, socket: &mut impl Socket) -> bool {
        self.written == 0 && socket.gather(&[IoSlice::new(&self.head), IoSlice::new(&self.message.payload)])
    }

    /// Writes as much of the next piece as the socket accepts.
    ///
    /// # Errors
    /// Returns the socket's error.
    pub(super) fn write_to(&mut self, socket: &mut impl Socket) -> io::Result<Written> {
        let head = &self.head[self.written.min(HEADER_LEN)..];
        let payload = &self.message.payload[self.written.saturating_sub(HEADER_LEN)..];
        let payload = &payload[..payload.len().min(socket.piece_max())];
        let offered = head.len() + payload.len();
        let taken = socket.try_write_vectored(&[IoSlice::new(head), IoSlice::new(payload)])?;
        self.written += taken;
        Ok(if self.written == self.message.size() {
            Written::Whole
        } else if taken == offered {
            Written::Piece
        } else {
            Written::InPart
        })
    }
}
