//! A frame on its way into a socket.

use std::io::{self, IoSlice};

use sinew_runtime::wire::{Checksum, HEADER_LEN, Message};

use super::Socket;

/// A frame of which the socket has taken the first bytes, or none yet.
pub(super) struct Partial {
    pub(super) message: Message,
    head: [u8; HEADER_LEN],
    pub(super) written: usize,
    pub(super) sort: Sort,
}

/// Whose a frame is.
#[derive(Clone, Copy, PartialEq, Eq)]
pub(super) enum Sort {
    /// A sender's message, for the first time.
    Message,
    /// A message that the session keeps, or a void in its place: it was counted when it was written first.
    Again,
    /// The connection's own: the first, the last, one that went ahead. It belongs to that one, and to no sender.
    Frill,
}

/// How a write ended.
pub(super) enum Written {
    Whole,
    /// As much of it as is written at once; the socket may take more.
    Piece,
    /// The socket takes no more now.
    InPart,
    Broken,
}

impl Partial {
    pub(super) fn new(message: Message, checksum: Checksum, sort: Sort) -> Self {
        let head = checksum.encode(&message.header, &message.payload);
        Self { message, head, written: 0, sort }
    }

    /// Lets the socket gather it whole; returns whether it did.
    pub(super) fn gather_in(&self, socket: &mut impl Socket) -> bool {
        self.written == 0 && socket.gather(&[IoSlice::new(&self.head), IoSlice::new(&self.message.payload)])
    }

    /// Writes what the socket takes of the next piece.
    ///
    /// # Errors
    /// The socket's.
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
