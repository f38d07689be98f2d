//! The plain socket to the node.

use std::{
    io::IoSlice,
    os::{
        fd::{AsFd, BorrowedFd},
        unix::net::UnixStream,
    },
    sync::{Arc, Mutex, MutexGuard, PoisonError},
    time::Duration,
};

use bytes::{Buf, BytesMut};
use rustix::{
    event::{PollFd, PollFlags, Timespec, poll},
    io::Errno,
    net::{RecvFlags, SendAncillaryBuffer, SendFlags, Shutdown, recv, sendmsg},
};
use sinew_protocol::ring::begins_with_frame;
use sinew_runtime::{
    outcome::{Outcome, ReceiptSink, Ticket},
    time::Time,
    wire::{FrameCodec, HEADER_LEN, Message, encode_frame},
};
use tokio::sync::Notify;
use tokio_util::codec::Decoder;

use super::{Ended, LinkOptions, Progress, Read, ring::PENDING_MAX};
use crate::{
    ApiError,
    stall_timeout::{Limit, Waiting},
};

/// Bytes per read.
const READ_CHUNK: usize = 64 * 1024;
/// Maximum bytes of the backlog; an outcome beyond it is dropped. It holds as many outcomes as a ring's queue.
const BACKLOG_BYTES_MAX: usize = PENDING_MAX * (HEADER_LEN + 1);

/// The writing half. Any thread that settles a message writes to it.
#[derive(Debug)]
pub(crate) struct Writer {
    socket: Arc<UnixStream>,
    /// Frames are written completely, one after the other.
    state: Mutex<SendState>,
    /// Notified when a thread has left an outcome there, so that a waiting task checks again.
    pub(super) pending_notify: Notify,
    stall_timeout: Duration,
}

/// The data being written. Locked only briefly: no thread waits for room under this lock.
#[derive(Debug, Default)]
struct SendState {
    /// The rest of a frame that found no room.
    backlog: BytesMut,
    /// Bytes that the socket has accepted; wraps around.
    taken: u32,
}

/// The progress of writing a frame.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Pushed {
    Whole,
    /// The rest is in the backlog.
    Part,
    Nothing,
}

impl Writer {
    pub(crate) fn new(socket: Arc<UnixStream>, options: &LinkOptions) -> Self {
        Self {
            socket,
            state: Mutex::default(),
            pending_notify: Notify::new(),
            stall_timeout: options.stall_timeout,
        }
    }

    pub(crate) fn fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }

    fn state(&self) -> MutexGuard<'_, SendState> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Writes one frame as far as there is room now; the rest of it is kept here.
    pub(super) fn begin(&self, message: Message) -> Result<Progress, ApiError> {
        Ok(match self.push(&mut self.state(), &message)? {
            Pushed::Whole => Progress::Whole,
            Pushed::Part => Progress::Part(None),
            Pushed::Nothing => Progress::Full(message),
        })
    }

    /// Writes the backlog as far as there is room now.
    pub(super) fn flush_pending(&self) {
        // The error appears again when the socket is read.
        let _ = self.write_backlog(&mut self.state());
    }

    /// Returns whether there is a backlog.
    pub(super) fn has_pending(&self) -> bool {
        !self.state().backlog.is_empty()
    }

    /// Returns the node's read counter: the node makes room for the bytes that the socket accepts.
    pub(super) fn taken(&self) -> u32 {
        self.state().taken
    }

    /// Waits until there may be room, or until the deadline.
    pub(super) fn await_room(&self, deadline: Time) {
        // The error appears again on the next write.
        let _ = wait(&self.socket, PollFlags::OUT, deadline);
    }

    fn push(&self, state: &mut SendState, message: &Message) -> Result<Pushed, ApiError> {
        if !self.write_backlog(state)? {
            return Ok(Pushed::Nothing);
        }
        let head = message.header.encode(&message.payload);
        let written = match self.write_now(&[IoSlice::new(&head), IoSlice::new(&message.payload)]) {
            Ok(count) => count,
            Err(Errno::AGAIN) => return Ok(Pushed::Nothing),
            Err(error) => return Err(ApiError::Closed(error.to_string())),
        };
        state.taken = state.taken.wrapping_add(written as u32);
        if written == message.size() {
            return Ok(Pushed::Whole);
        }
        state.backlog.extend_from_slice(&head[written.min(head.len())..]);
        state.backlog.extend_from_slice(&message.payload[written.saturating_sub(head.len())..]);
        Ok(if self.write_backlog(state)? { Pushed::Whole } else { Pushed::Part })
    }

    /// Writes the backlog. Returns whether all of it is written.
    fn write_backlog(&self, state: &mut SendState) -> Result<bool, ApiError> {
        while !state.backlog.is_empty() {
            match self.write_now(&[IoSlice::new(&state.backlog)]) {
                Ok(count) => {
                    state.backlog.advance(count);
                    state.taken = state.taken.wrapping_add(count as u32);
                }
                Err(Errno::AGAIN) => return Ok(false),
                Err(error) => {
                    state.backlog.clear();
                    return Err(ApiError::Closed(error.to_string()));
                }
            }
        }
        Ok(true)
    }

    /// Queues an outcome without waiting. An outcome beyond the bound is dropped, and counts as Unknown at
    /// its deadline.
    fn queue_outcome(&self, outcome: &Message) {
        let mut state = self.state();
        if state.backlog.len() < BACKLOG_BYTES_MAX {
            encode_frame(&outcome.header, &outcome.payload, &mut state.backlog);
        }
        if !self.write_backlog(&mut state).unwrap_or(true) {
            self.pending_notify.notify_one();
        }
    }

    /// Writes one frame, and waits for room for at most the stall timeout.
    pub(crate) fn write(&self, message: &Message) -> Result<(), ApiError> {
        let mut waiting = Waiting::new(Limit::stall_timeout(self.stall_timeout));
        let mut pushed = Pushed::Nothing;
        loop {
            let taken = {
                let mut state = self.state();
                pushed = match pushed {
                    Pushed::Nothing => self.push(&mut state, message)?,
                    Pushed::Part | Pushed::Whole if self.write_backlog(&mut state)? => Pushed::Whole,
                    Pushed::Part | Pushed::Whole => Pushed::Part,
                };
                state.taken
            };
            if pushed == Pushed::Whole {
                return Ok(());
            }
            let Some(until) = waiting.until(taken, Time::now()) else { break };
            self.await_room(until);
        }
        // The rest of a partly written frame is sent by later calls.
        if pushed == Pushed::Part { Ok(()) } else { Err(waiting.error()) }
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

    /// Closes the connection, which releases the address.
    pub(crate) fn close(&self) {
        // An error means that it is closed already.
        let _ = rustix::net::shutdown(&self.socket, Shutdown::Both);
    }
}

impl ReceiptSink for Writer {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        // Never waits: the settling thread may be in a loop of its own. If the connection has ended, the node
        // notifies the sender.
        self.queue_outcome(&Message::outcome(ticket, outcome));
    }
}

/// The reading half.
pub(crate) struct Reader {
    socket: Arc<UnixStream>,
    codec: FrameCodec,
    buffer: BytesMut,
    chunk: Box<[u8]>,
    /// No data is taken any more.
    is_stopped: bool,
}

impl Reader {
    pub(crate) fn new(socket: Arc<UnixStream>, payload_max: usize) -> Self {
        let chunk = vec![0; READ_CHUNK].into();
        Self {
            socket,
            codec: FrameCodec::new(payload_max),
            buffer: BytesMut::new(),
            chunk,
            is_stopped: false,
        }
    }

    /// Returns the next frame of those that were read.
    pub(crate) fn next(&mut self) -> Result<Option<Message>, ApiError> {
        Ok(self.codec.decode(&mut self.buffer)?)
    }

    pub(crate) fn has_frame(&self) -> bool {
        begins_with_frame(&self.buffer)
    }

    /// Stops taking data.
    pub(crate) fn stop_reading(&mut self) {
        self.is_stopped = true;
        self.buffer.clear();
    }

    /// Reads the data that has arrived, without waiting.
    pub(crate) fn read(&mut self) -> Read {
        if self.is_stopped {
            return Read::Ended(Ended::without_reason());
        }
        let room = FrameCodec::room(&self.buffer, self.chunk.len());
        loop {
            match recv(&self.socket, &mut self.chunk[..room], RecvFlags::DONTWAIT) {
                Ok((0, _)) => return Read::Ended(Ended::without_reason()),
                Ok((count, _)) => {
                    self.buffer.extend_from_slice(&self.chunk[..count]);
                    return Read::Some;
                }
                Err(Errno::INTR) => {}
                Err(Errno::AGAIN) => return Read::Nothing,
                Err(_) => return Read::Ended(Ended::without_reason()),
            }
        }
    }

    /// The socket.
    pub(crate) fn fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }

    /// Waits until there is something to read, or until the deadline.
    pub(crate) fn wait(&self, deadline: Time) {
        // The error appears again when the socket is read.
        let _ = wait(&self.socket, PollFlags::IN, deadline);
    }
}

/// Returns whether the other end is closed. Does not wait.
pub(crate) fn has_hung_up(socket: &UnixStream) -> bool {
    hangs_up(socket)
}

/// The same for any kind of socket.
pub(crate) fn hangs_up(socket: impl AsFd) -> bool {
    let nothing = Timespec { tv_sec: 0, tv_nsec: 0 };
    poll(&mut [PollFd::new(&socket, PollFlags::RDHUP)], Some(&nothing)).is_ok_and(|count| count > 0)
}

/// Returns the indices of the `sockets` with a closed other end, with one system call for all. Does not wait.
pub(crate) fn which_hung_up<'a>(sockets: impl Iterator<Item = &'a UnixStream>) -> Vec<usize> {
    let nothing = Timespec { tv_sec: 0, tv_nsec: 0 };
    let mut ends: Vec<_> = sockets.map(|socket| PollFd::new(socket, PollFlags::RDHUP)).collect();
    match poll(&mut ends, Some(&nothing)) {
        Ok(1..) => {
            (0..).zip(&ends).filter(|(_, end)| !end.revents().is_empty()).map(|(index, _)| index).collect()
        }
        // They are checked again later.
        Ok(0) | Err(_) => Vec::new(),
    }
}

/// Waits for the socket. Returns whether it is ready, `false` at the deadline. One wake of the calling thread.
pub(crate) fn wait(socket: &UnixStream, what: PollFlags, deadline: Time) -> Result<bool, Errno> {
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

#[cfg(test)]
mod tests {
    use std::{io::Read as _, sync::mpsc::sync_channel, thread};

    use sinew_runtime::{
        tid::Tid,
        wire::{Header, Kind},
    };

    use super::*;
    use crate::Registration;

    const WATCHDOG: Duration = Duration::from_secs(60);

    #[test]
    fn outcome_without_room_is_sent_later_without_waiting() {
        // given: a socket that takes no more, and a stall timeout without an end
        let (ours, theirs) = UnixStream::pair().unwrap();
        let options = Registration::new().stall_timeout(Duration::MAX).link;
        let writer = Arc::new(Writer::new(Arc::new(ours), &options));
        let filling =
            || Message::new(Header::new(Kind::named("x"), Tid::NONE, Tid::NONE), vec![0; 4_096].into());
        while matches!(writer.begin(filling()).unwrap(), Progress::Whole) {}
        // when
        let (report, settled) = sync_channel(1);
        let settling = writer.clone();
        thread::spawn(move || {
            let ticket = Ticket { source: Tid::NONE, destination: Tid::NONE, correlation: 7 };
            settling.settle(ticket, Outcome::Failed);
            report.send(()).unwrap();
        });
        // then
        settled.recv_timeout(WATCHDOG).expect("waited for the settling thread");
        let (mut codec, mut buffer) = (FrameCodec::new(4_096), BytesMut::new());
        theirs.set_read_timeout(Some(WATCHDOG)).unwrap();
        let outcome = loop {
            writer.flush_pending();
            let mut chunk = [0; 65_536];
            let count = (&theirs).read(&mut chunk).expect("waited for the outcome");
            buffer.extend_from_slice(&chunk[..count]);
            let mut frames = std::iter::from_fn(|| codec.decode(&mut buffer).unwrap());
            if let Some(outcome) = frames.find(|message| message.header.kind == Kind::OUTCOME) {
                break outcome;
            }
        };
        assert_eq!(
            (outcome.header.correlation, outcome.payload[..].to_vec()),
            (7, vec![Outcome::Failed.code()])
        );
    }
}
