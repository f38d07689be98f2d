//! The plain socket to the node.

use std::{
    io::IoSlice,
    os::{
        fd::{AsFd, BorrowedFd},
        unix::net::UnixStream,
    },
    sync::{Arc, Mutex, PoisonError},
    time::Duration,
};

use bytes::{Buf, BytesMut};
use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    io::Errno,
    net::{RecvFlags, SendAncillaryBuffer, SendFlags, Shutdown, recv, sendmsg},
};
use sinew_runtime::{
    outcome::{Outcome, ReceiptSink, Ticket},
    time::Time,
    wire::{FrameCodec, HEADER_LEN, Message, encode_frame},
};
use sinew_shm::BellKind;
use tokio::sync::Notify;
use tokio_util::codec::Decoder;

use super::{Ended, LinkOptions, Progress, Read, ring::OWED_MAX};
use crate::api::ApiError;

/// Bytes that are read at once.
const READ_CHUNK: usize = 64 * 1024;
/// What may be left before an outcome that is to be said is left out: as many as at a ring.
const BACKLOG_BYTES_MAX: usize = OWED_MAX * (HEADER_LEN + 1);

/// The writing half: whoever settles a message writes, from whatever thread.
#[derive(Debug)]
pub(in crate::api) struct Writer {
    socket: Arc<UnixStream>,
    /// Frames go out whole, one after the other. What could not be written at once is here, where tasks write, who do not
    /// wait; else it is empty.
    turn: Mutex<BytesMut>,
    /// Told when some thread has left an outcome there: a task that waits looks again.
    pub(super) owing: Notify,
    patience: Duration,
    waits: Waits,
}

/// What who writes does where there is no room.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Waits {
    /// It is a thread that may block.
    Here,
    /// It is a task.
    Elsewhere,
}

/// How far a frame came, of one who waits.
enum Stuck {
    /// Nothing of it was written.
    Before,
    /// Part of it was written: nothing after it would be understood.
    Within,
}

impl Writer {
    pub(in crate::api) fn new(socket: Arc<UnixStream>, options: LinkOptions) -> Self {
        let waits = if options.bell == BellKind::Futex { Waits::Here } else { Waits::Elsewhere };
        Self { socket, turn: Mutex::default(), owing: Notify::new(), patience: options.patience, waits }
    }

    /// Writes one frame as far as there is room now; what is left of it is kept here.
    pub(super) fn begin(&self, message: Message) -> Result<Progress, ApiError> {
        let mut backlog = self.turn.lock().unwrap_or_else(PoisonError::into_inner);
        if !self.work_off(&mut backlog)? {
            return Ok(Progress::Full(message));
        }
        encode_frame(&message.header, &message.payload, &mut backlog);
        let whole = backlog.len();
        if self.work_off(&mut backlog)? {
            return Ok(Progress::Whole);
        }
        if backlog.len() < whole {
            return Ok(Progress::Part(None));
        }
        backlog.clear();
        Ok(Progress::Full(message))
    }

    /// Writes on what was left, as far as there is room now.
    pub(super) fn pay(&self) {
        // An error shows itself again when the socket is read.
        let _ = self.work_off(&mut self.turn.lock().unwrap_or_else(PoisonError::into_inner));
    }

    /// Whether something is left.
    pub(super) fn owes(&self) -> bool {
        !self.turn.lock().unwrap_or_else(PoisonError::into_inner).is_empty()
    }

    /// Whether all is written.
    fn work_off(&self, backlog: &mut BytesMut) -> Result<bool, ApiError> {
        while !backlog.is_empty() {
            match self.write_now(&[IoSlice::new(backlog)]) {
                Ok(count) => backlog.advance(count),
                Err(Errno::AGAIN) => return Ok(false),
                Err(error) => {
                    backlog.clear();
                    return Err(ApiError::Closed(error.to_string()));
                }
            }
        }
        Ok(true)
    }

    /// Says an outcome without waiting; one more than there may be is not said, and counts as Unknown at its deadline.
    fn owe(&self, outcome: &Message) {
        let mut backlog = self.turn.lock().unwrap_or_else(PoisonError::into_inner);
        if backlog.len() < BACKLOG_BYTES_MAX {
            encode_frame(&outcome.header, &outcome.payload, &mut backlog);
        }
        if !self.work_off(&mut backlog).unwrap_or(true) {
            self.owing.notify_one();
        }
    }

    /// Writes one frame.
    pub(in crate::api) fn write(&self, message: &Message) -> Result<(), ApiError> {
        let head = message.header.encode(&message.payload);
        // A turn that ended in a panic wrote a frame in part, and closed the socket.
        let _turn = self.turn.lock().unwrap_or_else(PoisonError::into_inner);
        let whole = message.size();
        let deadline = Time::now() + self.patience;
        let mut written = 0;
        while written < whole {
            let head = &head[written.min(head.len())..];
            let payload = &message.payload[written.saturating_sub(whole - message.payload.len())..];
            let parts = [IoSlice::new(head), IoSlice::new(payload)];
            match self.write_some(&parts, deadline) {
                Ok(count) => written += count,
                Err(error) => {
                    return Err(self.give_up(error, if written == 0 { Stuck::Before } else { Stuck::Within }));
                }
            }
        }
        Ok(())
    }

    fn write_now(&self, parts: &[IoSlice<'_>]) -> Result<usize, Errno> {
        let flags = SendFlags::DONTWAIT | SendFlags::NOSIGNAL;
        loop {
            match sendmsg(&self.socket, parts, &mut SendAncillaryBuffer::default(), flags) {
                Err(Errno::INTR) => {}
                result => return result,
            }
        }
    }

    fn write_some(&self, parts: &[IoSlice<'_>], deadline: Time) -> Result<usize, Errno> {
        loop {
            match self.write_now(parts) {
                Err(Errno::AGAIN) if wait(&self.socket, PollFlags::OUT, deadline)? => {}
                result => return result,
            }
        }
    }

    fn give_up(&self, error: Errno, stuck: Stuck) -> ApiError {
        match (error, stuck) {
            (Errno::AGAIN, Stuck::Before) => ApiError::Stalled(self.patience),
            (Errno::AGAIN, Stuck::Within) => {
                self.close();
                ApiError::Closed(format!("the node stopped reading for {:?} within a frame", self.patience))
            }
            (error, Stuck::Before | Stuck::Within) => ApiError::Closed(error.to_string()),
        }
    }

    /// Closes the connection, which gives the address back.
    pub(in crate::api) fn close(&self) {
        // An error means that it is closed already.
        let _ = rustix::net::shutdown(&self.socket, Shutdown::Both);
    }
}

impl ReceiptSink for Writer {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        let outcome = Message::outcome(ticket, outcome);
        match self.waits {
            // If it cannot be said the connection has ended, and the node tells the sender so.
            Waits::Here => drop(self.write(&outcome)),
            Waits::Elsewhere => self.owe(&outcome),
        }
    }
}

/// The reading half.
pub(in crate::api) struct Reader {
    socket: Arc<UnixStream>,
    codec: FrameCodec,
    buffer: BytesMut,
    chunk: Box<[u8]>,
}

impl Reader {
    pub(in crate::api) fn new(socket: Arc<UnixStream>, payload_max: usize) -> Self {
        let chunk = vec![0; READ_CHUNK].into();
        Self { socket, codec: FrameCodec::new(payload_max), buffer: BytesMut::new(), chunk }
    }

    /// The next frame of those that were read.
    pub(in crate::api) fn next(&mut self) -> Result<Option<Message>, ApiError> {
        Ok(self.codec.decode(&mut self.buffer)?)
    }

    /// Reads what is there, without waiting.
    pub(in crate::api) fn read(&mut self) -> Read {
        loop {
            match recv(&self.socket, &mut self.chunk[..], RecvFlags::DONTWAIT) {
                Ok((0, _)) => return Read::Ended(Ended::silently()),
                Ok((count, _)) => {
                    self.buffer.extend_from_slice(&self.chunk[..count]);
                    return Read::Some;
                }
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => return Read::Nothing,
                Err(_) => return Read::Ended(Ended::silently()),
            }
        }
    }

    /// The socket.
    pub(in crate::api) fn fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }

    /// Waits until there is something to read, or until the deadline.
    pub(in crate::api) fn wait(&self, deadline: Time) {
        // An error shows itself again when the socket is read.
        let _ = wait(&self.socket, PollFlags::IN, deadline);
    }
}

/// Whether the other end is closed. Does not wait.
pub(in crate::api) fn has_hung_up(socket: &UnixStream) -> bool {
    hangs_up(socket)
}

/// The same for whatever is a socket.
pub(in crate::api) fn hangs_up(socket: impl AsFd) -> bool {
    let nothing = Timespec { tv_sec: 0, tv_nsec: 0 };
    poll(&mut [PollFd::new(&socket, PollFlags::RDHUP)], Some(&nothing)).is_ok_and(|count| count > 0)
}

/// Those of `sockets` whose other end is closed: one system call for all. Does not wait.
pub(in crate::api) fn which_hung_up<'a>(sockets: impl Iterator<Item = &'a UnixStream>) -> Vec<usize> {
    let nothing = Timespec { tv_sec: 0, tv_nsec: 0 };
    let mut ends: Vec<_> = sockets.map(|socket| PollFd::new(socket, PollFlags::RDHUP)).collect();
    match poll(&mut ends, Some(&nothing)) {
        Ok(1..) => {
            (0..).zip(&ends).filter(|(_, end)| !end.revents().is_empty()).map(|(index, _)| index).collect()
        }
        // They are looked at again.
        Ok(0) | Err(_) => Vec::new(),
    }
}

/// Waits for the socket; returns whether it is ready, `false` at the deadline. One wake of the calling thread.
pub(super) fn wait(socket: &UnixStream, what: PollFlags, deadline: Time) -> Result<bool, Errno> {
    loop {
        let left = deadline.since(Time::now());
        let timeout = Timespec::try_from(left).unwrap_or(Timespec { tv_sec: i64::MAX, tv_nsec: 0 });
        match poll(&mut [PollFd::new(socket, what)], Some(&timeout)) {
            Ok(0) if Time::now() >= deadline => return Ok(false),
            Ok(0) | Err(Errno::INTR) => {}
            Ok(_) => return Ok(true),
            Err(error) => return Err(error),
        }
    }
}
