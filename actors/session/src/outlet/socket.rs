//! The socket of a connection: any thread writes to it, and one task waits until it is writable.

use std::{
    io::{self, IoSlice},
    sync::Arc,
    task::{Context, Poll},
};

use sinew_runtime::wire::Checksum;
use tokio::net::UnixStream;

/// A non-blocking socket, or an equivalent, that any thread can write to.
pub trait Socket: Send + 'static {
    /// The checksum of the frames on this socket.
    fn checksum(&self) -> Checksum {
        Checksum::Crc
    }

    /// Payload bytes per write under the outlet's lock. Other threads wait for the lock during this write.
    fn piece_max(&self) -> usize {
        usize::MAX
    }

    /// Writes as many bytes as the socket accepts at once, starting with the first byte of `parts`.
    ///
    /// # Errors
    /// [`io::ErrorKind::WouldBlock`] if the socket accepts nothing now. Any other error ends the connection.
    fn try_write_vectored(&mut self, parts: &[IoSlice<'_>]) -> io::Result<usize>;

    /// Bytes written so far, as in [`account`](Self::account). This is cheap, because the peer's counter is
    /// not read.
    fn written(&self) -> u64 {
        0
    }

    /// Bytes written so far, and bytes that the peer has taken so far, in the same unit, if the socket can
    /// report them.
    fn account(&mut self) -> Account {
        Account { written: 0, taken: u64::MAX }
    }

    /// Whether the socket gathers frames to write many at once.
    fn gathers(&self) -> bool {
        false
    }

    /// Bytes of frames that the buffer has room for.
    fn gather_room(&self) -> usize {
        0
    }

    /// Copies a whole frame behind the frames gathered before. Returns whether the buffer had room.
    fn gather(&mut self, parts: &[IoSlice<'_>]) -> bool {
        let _ = parts;
        false
    }

    /// Gathered bytes that are not written yet. While there are any, nothing else is written.
    fn gathered(&self) -> usize {
        0
    }

    /// Writes as many gathered bytes as the socket accepts at once.
    ///
    /// # Errors
    /// As [`try_write_vectored`](Self::try_write_vectored).
    fn write_gathered(&mut self) -> io::Result<usize> {
        Ok(0)
    }

    /// Schedules a delayed wake of the drain task, so that more messages can be batched. Returns `false` if
    /// no timer is available; the caller must then wake the drain task now.
    fn wake_later(&mut self) -> bool {
        false
    }

    /// Counts a message that was added to a queued one. Enough of them postpone the delayed wake of
    /// [`wake_later`](Self::wake_later), up to a maximum.
    fn joins_delayed(&mut self) {}

    /// Records that a sender has written the queued messages, so that later ones may postpone the delayed wake again.
    fn wrote_delayed(&mut self) {}

    /// Registers the awake drain task for the delayed wake of [`wake_later`](Self::wake_later).
    fn poll_delayed_wake(&mut self, cx: &mut Context<'_>) {
        let _ = cx;
    }

    /// Returns ready when the socket may accept bytes. Only one task may call this: the drain task.
    fn poll_writable(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<()>>;
}

/// Progress of the peer in the bytes written. The peer may have handled a frame written before `taken`; it
/// has not handled a later frame.
#[derive(Clone, Copy, Debug)]
pub struct Account {
    /// What was written so far, in the unit of the socket.
    pub written: u64,
    /// What the peer has taken of it so far.
    pub taken: u64,
}

impl Socket for Arc<UnixStream> {
    fn try_write_vectored(&mut self, parts: &[IoSlice<'_>]) -> io::Result<usize> {
        UnixStream::try_write_vectored(self, parts)
    }

    fn poll_writable(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        self.poll_write_ready(cx)
    }
}
