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
use sinew_runtime::{
    outcome::{Outcome, ReceiptSink, Ticket},
    time::Time,
    wire::{FrameCodec, HEADER_LEN, Message, encode_frame},
};
use tokio::sync::Notify;
use tokio_util::codec::Decoder;

use super::{Ended, LinkOptions, Progress, Read, ring::OWED_MAX};
use crate::client::{
    ApiError,
    stall_timeout::{Limit, Waiting},
};

/// Bytes that are read at once.
const READ_CHUNK: usize = 64 * 1024;
/// What may be left before an outcome that is to be said is left out: as many as at a ring.
const BACKLOG_BYTES_MAX: usize = OWED_MAX * (HEADER_LEN + 1);

/// The writing half: whoever settles a message writes, from whatever thread.
#[derive(Debug)]
pub(in crate::client) struct Writer {
    socket: Arc<UnixStream>,
    /// Frames go out whole, one after the other.
    turn: Mutex<Turn>,
    /// Told when some thread has left an outcome there: a task that waits looks again.
    pub(super) owing: Notify,
    stall_timeout: Duration,
}

/// What is on its way out. Kept for a moment only: nobody waits for room with it in hand.
#[derive(Debug, Default)]
struct Turn {
    /// What was begun and found no room.
    backlog: BytesMut,
    /// Bytes that the socket took; wraps.
    taken: u32,
}

/// How far a frame came.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Pushed {
    Whole,
    /// The rest is in the backlog.
    Part,
    Nothing,
}

impl Writer {
    pub(in crate::client) fn new(socket: Arc<UnixStream>, options: &LinkOptions) -> Self {
        Self { socket, turn: Mutex::default(), owing: Notify::new(), stall_timeout: options.stall_timeout }
    }

    fn turn(&self) -> MutexGuard<'_, Turn> {
        self.turn.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Writes one frame as far as there is room now; what is left of it is kept here.
    pub(super) fn begin(&self, message: Message) -> Result<Progress, ApiError> {
        Ok(match self.push(&mut self.turn(), &message)? {
            Pushed::Whole => Progress::Whole,
            Pushed::Part => Progress::Part(None),
            Pushed::Nothing => Progress::Full(message),
        })
    }

    /// Writes on what was left, as far as there is room now.
    pub(super) fn pay(&self) {
        // An error shows itself again when the socket is read.
        let _ = self.work_off(&mut self.turn());
    }

    /// Whether something is left.
    pub(super) fn owes(&self) -> bool {
        !self.turn().backlog.is_empty()
    }

    /// A count of what the node takes: it makes room for what the socket takes.
    pub(super) fn taken(&self) -> u32 {
        self.turn().taken
    }

    /// Waits until there may be room, or until the deadline.
    pub(super) fn await_room(&self, deadline: Time) {
        // An error shows itself again when it is written.
        let _ = wait(&self.socket, PollFlags::OUT, deadline);
    }

    fn push(&self, turn: &mut Turn, message: &Message) -> Result<Pushed, ApiError> {
        if !self.work_off(turn)? {
            return Ok(Pushed::Nothing);
        }
        let head = message.header.encode(&message.payload);
        let written = match self.write_now(&[IoSlice::new(&head), IoSlice::new(&message.payload)]) {
            Ok(count) => count,
            Err(Errno::AGAIN) => return Ok(Pushed::Nothing),
            Err(error) => return Err(ApiError::Closed(error.to_string())),
        };
        turn.taken = turn.taken.wrapping_add(written as u32);
        if written == message.size() {
            return Ok(Pushed::Whole);
        }
        turn.backlog.extend_from_slice(&head[written.min(head.len())..]);
        turn.backlog.extend_from_slice(&message.payload[written.saturating_sub(head.len())..]);
        Ok(if self.work_off(turn)? { Pushed::Whole } else { Pushed::Part })
    }

    /// Whether all is written.
    fn work_off(&self, turn: &mut Turn) -> Result<bool, ApiError> {
        while !turn.backlog.is_empty() {
            match self.write_now(&[IoSlice::new(&turn.backlog)]) {
                Ok(count) => {
                    turn.backlog.advance(count);
                    turn.taken = turn.taken.wrapping_add(count as u32);
                }
                Err(Errno::AGAIN) => return Ok(false),
                Err(error) => {
                    turn.backlog.clear();
                    return Err(ApiError::Closed(error.to_string()));
                }
            }
        }
        Ok(true)
    }

    /// Says an outcome without waiting; one more than there may be is not said, and counts as Unknown at its deadline.
    fn owe(&self, outcome: &Message) {
        let mut turn = self.turn();
        if turn.backlog.len() < BACKLOG_BYTES_MAX {
            encode_frame(&outcome.header, &outcome.payload, &mut turn.backlog);
        }
        if !self.work_off(&mut turn).unwrap_or(true) {
            self.owing.notify_one();
        }
    }

    /// Writes one frame, and waits for room for as long as the stall timeout lasts.
    pub(in crate::client) fn write(&self, message: &Message) -> Result<(), ApiError> {
        let mut waiting = Waiting::new(Limit::stall_timeout(self.stall_timeout));
        let mut pushed = Pushed::Nothing;
        loop {
            let taken = {
                let mut turn = self.turn();
                pushed = match pushed {
                    Pushed::Nothing => self.push(&mut turn, message)?,
                    Pushed::Part | Pushed::Whole if self.work_off(&mut turn)? => Pushed::Whole,
                    Pushed::Part | Pushed::Whole => Pushed::Part,
                };
                turn.taken
            };
            if pushed == Pushed::Whole {
                return Ok(());
            }
            let Some(until) = waiting.until(taken, Time::now()) else { break };
            self.await_room(until);
        }
        // What was begun goes out with later calls.
        if pushed == Pushed::Part { Ok(()) } else { Err(waiting.in_vain()) }
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

    /// Closes the connection, which gives the address back.
    pub(in crate::client) fn close(&self) {
        // An error means that it is closed already.
        let _ = rustix::net::shutdown(&self.socket, Shutdown::Both);
    }
}

impl ReceiptSink for Writer {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        // Never waits: whoever settles may be in a loop of its own. If the connection has ended the node tells the sender so.
        self.owe(&Message::outcome(ticket, outcome));
    }
}

/// The reading half.
pub(in crate::client) struct Reader {
    socket: Arc<UnixStream>,
    codec: FrameCodec,
    buffer: BytesMut,
    chunk: Box<[u8]>,
    /// Nothing is taken any more.
    is_turned_away: bool,
}

impl Reader {
    pub(in crate::client) fn new(socket: Arc<UnixStream>, payload_max: usize) -> Self {
        let chunk = vec![0; READ_CHUNK].into();
        Self {
            socket,
            codec: FrameCodec::new(payload_max),
            buffer: BytesMut::new(),
            chunk,
            is_turned_away: false,
        }
    }

    /// The next frame of those that were read.
    pub(in crate::client) fn next(&mut self) -> Result<Option<Message>, ApiError> {
        Ok(self.codec.decode(&mut self.buffer)?)
    }

    /// Takes nothing any more.
    pub(in crate::client) fn turn_away(&mut self) {
        self.is_turned_away = true;
        self.buffer.clear();
    }

    /// Reads what is there, without waiting.
    pub(in crate::client) fn read(&mut self) -> Read {
        if self.is_turned_away {
            return Read::Ended(Ended::silently());
        }
        let room = FrameCodec::room(&self.buffer, self.chunk.len());
        loop {
            match recv(&self.socket, &mut self.chunk[..room], RecvFlags::DONTWAIT) {
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
    pub(in crate::client) fn fd(&self) -> BorrowedFd<'_> {
        self.socket.as_fd()
    }

    /// Waits until there is something to read, or until the deadline.
    pub(in crate::client) fn wait(&self, deadline: Time) {
        // An error shows itself again when the socket is read.
        let _ = wait(&self.socket, PollFlags::IN, deadline);
    }
}

/// Whether the other end is closed. Does not wait.
pub(in crate::client) fn has_hung_up(socket: &UnixStream) -> bool {
    hangs_up(socket)
}

/// The same for whatever is a socket.
pub(in crate::client) fn hangs_up(socket: impl AsFd) -> bool {
    let nothing = Timespec { tv_sec: 0, tv_nsec: 0 };
    poll(&mut [PollFd::new(&socket, PollFlags::RDHUP)], Some(&nothing)).is_ok_and(|count| count > 0)
}

/// Those of `sockets` whose other end is closed: one system call for all. Does not wait.
pub(in crate::client) fn which_hung_up<'a>(sockets: impl Iterator<Item = &'a UnixStream>) -> Vec<usize> {
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
pub(in crate::client) fn wait(socket: &UnixStream, what: PollFlags, deadline: Time) -> Result<bool, Errno> {
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
    use crate::client::Registration;

    const WATCHDOG: Duration = Duration::from_secs(60);

    #[test]
    fn an_outcome_that_finds_no_room_is_said_later_and_nobody_waits_for_that() {
        // given: a socket that takes no more, and a stall timeout without an end
        let (ours, theirs) = UnixStream::pair().unwrap();
        let options = Registration::new().stall_timeout(Duration::MAX).link;
        let writer = Arc::new(Writer::new(Arc::new(ours), &options));
        let filling =
            || Message::new(Header::new(Kind::named("x"), Tid::NONE, Tid::NONE), vec![0; 4_096].into());
        while matches!(writer.begin(filling()).unwrap(), Progress::Whole) {}
        // when
        let (say, settled) = sync_channel(1);
        let settling = writer.clone();
        thread::spawn(move || {
            let ticket = Ticket { source: Tid::NONE, destination: Tid::NONE, correlation: 7 };
            settling.settle(ticket, Outcome::Failed);
            say.send(()).unwrap();
        });
        // then
        settled.recv_timeout(WATCHDOG).expect("waited for the return of who settles");
        let (mut codec, mut buffer) = (FrameCodec::new(4_096), BytesMut::new());
        theirs.set_read_timeout(Some(WATCHDOG)).unwrap();
        let outcome = loop {
            writer.pay();
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
