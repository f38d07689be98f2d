//! The way to the node: whole frames out, bytes in, each with a bound on the wait. Two ways behind one: a plain socket, or
//! a ring each way in shared memory with the socket beside it, which then tells the node's end.

mod believed;
mod greeting;
pub(super) mod loan;
pub(super) mod ring;
pub(super) mod socket;

use std::{
    io::{self, ErrorKind},
    os::{fd::OwnedFd, unix::net::UnixStream},
    path::Path,
    sync::Arc,
    time::Duration,
};

use sinew_runtime::{
    outcome::{Outcome, ReceiptSink, Ticket},
    time::Time,
    wire::Message,
};
use sinew_shm::{Armed, Bell, Spin};
use socket2::{Domain, SockAddr, Socket, Type};

use super::{
    ApiError,
    loan::{Content, Draft},
};
use crate::lncl::payload::{Refusal, Register, Registered};

pub(super) use believed::{Believed, NotBelieved};
pub(super) use greeting::Greeting;
use loan::InRing;
use ring::{Begun, Rest};

/// How long to wait for a place in the queue of a node that does not accept, if the caller has as long.
pub(super) const CONNECT: Duration = Duration::from_secs(2);

/// What carries an endpoint's messages to its node and back.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Transport {
    /// A ring in shared memory for each direction: at most one wake a message. Whoever reads a message copies it out of the
    /// ring; one below 8 KiB, or that came with many others, a second time, into memory of its own. Where the system or the
    /// node has no rings it is the socket, which a line of the log says.
    #[default]
    Ring,
    /// The unix socket alone.
    Socket,
}

/// How a link is to be.
#[derive(Clone, Debug)]
pub(super) struct LinkOptions {
    pub(super) transport: Transport,
    pub(super) spin: Spin,
    /// How long a send waits for room.
    pub(super) stall_timeout: Duration,
    /// How this side is woken: by a futex where threads wait, one for all links of the endpoint; by a socket each where tasks do.
    pub(super) bell: Bell,
    /// Bytes of this side's ring of a direct link.
    pub(super) direct_ring_bytes: usize,
    /// Whom each connection takes for the node.
    pub(super) believed: Believed,
}

/// A registered link.
pub(super) struct Link {
    pub(super) registered: Registered,
    pub(super) writer: Arc<Writer>,
    pub(super) reader: Reader,
}

/// Connects to the node that listens at `path`, if it is one that is believed, until `deadline` at most.
pub(super) fn connect(path: &Path, believed: Believed, deadline: Time) -> Result<UnixStream, ApiError> {
    // To the system no time at all is as long as it takes.
    let least = Duration::from_millis(1);
    let within = deadline.since(Time::now()).clamp(least, CONNECT);
    let end = Time::now() + within;
    let address = address_of(path)?;
    let try_to = || -> io::Result<UnixStream> {
        let socket = Socket::new(Domain::UNIX, Type::STREAM, None)?;
        whatever_signals_come(end, |left| {
            // Linux bounds a unix socket's `connect` by the time allowed for sending.
            socket.set_write_timeout(Some(left.max(least)))?;
            socket.connect(&address)
        })?;
        socket.set_nonblocking(true)?;
        let stream = UnixStream::from(OwnedFd::from(socket));
        believed.check(&stream)?;
        Ok(stream)
    };
    try_to().map_err(|cause| {
        if matches!(cause.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted) {
            // Somebody listens, and takes nobody.
            return ApiError::NoAnswer(within);
        }
        ApiError::NoNode { path: path.to_owned(), cause }
    })
}

/// Has a call tried that has so much time left: a signal is no reason to give up before `end`.
fn whatever_signals_come(end: Time, mut call: impl FnMut(Duration) -> io::Result<()>) -> io::Result<()> {
    loop {
        match call(end.since(Time::now())) {
            Err(cause) if cause.kind() == ErrorKind::Interrupted && Time::now() < end => {}
            came => return came,
        }
    }
}

fn address_of(path: &Path) -> Result<SockAddr, ApiError> {
    let not_a_path = |why| ApiError::NotAPath { path: path.to_owned(), why };
    if path.as_os_str().is_empty() {
        // To the system that is a socket without a name.
        return Err(not_a_path("it is empty"));
    }
    SockAddr::unix(path).map_err(|_| not_a_path("it has more than 107 bytes, or a zero among them"))
}

/// How far a frame came.
pub(super) enum Progress {
    Whole,
    /// The rest is here, or with the writer itself.
    Part(Option<Rest>),
    /// Nothing of it was written.
    Full(Message),
}

/// The writing half: whoever settles a message writes, from whatever thread.
#[derive(Debug)]
pub(super) enum Writer {
    Socket(socket::Writer),
    Ring(Arc<ring::Writer>),
}

impl Writer {
    pub(super) const fn transport(&self) -> Transport {
        match self {
            Self::Socket(_) => Transport::Socket,
            Self::Ring(_) => Transport::Ring,
        }
    }

    /// Writes one of the layers' own frames, none of which is long; waits for room as long as the link's stall timeout lasts.
    pub(super) fn write(&self, message: &Message) -> Result<(), ApiError> {
        match self {
            Self::Socket(writer) => writer.write(message),
            Self::Ring(writer) => writer.write(message),
        }
    }

    /// Lends room for a payload of `length` bytes where it will travel from; `None` if there is none now.
    pub(super) fn lend(&self, length: usize) -> Option<InRing> {
        match self {
            Self::Socket(_) => None,
            Self::Ring(writer) => writer.lend(length),
        }
    }

    /// Sends a draft in place if its payload is in this very ring; else hands it back as a message.
    pub(super) fn send_in_place(&self, draft: Draft) -> Option<Message> {
        match (self, draft.payload) {
            (Self::Ring(writer), Content::InRing(loan)) if loan.is_of(writer) => {
                loan.publish(&draft.header);
                None
            }
            (Self::Ring(_) | Self::Socket(_), payload) => {
                Some(Message::new(draft.header, payload.into_bytes()))
            }
        }
    }

    /// Writes one frame as far as there is room now.
    pub(super) fn begin(&self, message: Message) -> Result<Progress, ApiError> {
        match self {
            Self::Socket(writer) => writer.begin(message),
            Self::Ring(writer) => match writer.begin(message) {
                Ok(Begun::Whole) => Ok(Progress::Whole),
                Ok(Begun::Part(rest)) => Ok(Progress::Part(Some(rest))),
                Ok(Begun::Full(message)) => Ok(Progress::Full(message)),
                Err((error, _)) => Err(error),
            },
        }
    }

    /// Whether the last frame was written in part, and the writer itself has the rest.
    pub(super) fn is_within_frame(&self) -> bool {
        match self {
            Self::Socket(writer) => writer.owes(),
            Self::Ring(_) => false,
        }
    }

    /// Whether outcomes wait for room.
    pub(super) fn owes(&self) -> bool {
        match self {
            Self::Socket(writer) => writer.owes(),
            Self::Ring(writer) => writer.owes(),
        }
    }

    /// Ends when some thread has left an outcome that waits for room.
    pub(super) async fn owing(&self) {
        match self {
            Self::Socket(writer) => writer.owing.notified().await,
            Self::Ring(writer) => writer.owing.notified().await,
        }
    }

    /// A count of what the node takes.
    pub(super) fn taken(&self) -> u32 {
        match self {
            Self::Socket(writer) => writer.taken(),
            Self::Ring(writer) => writer.taken(),
        }
    }

    /// Waits until there may be room for a frame of `length` bytes, for the node's end, or until `deadline`.
    pub(super) fn await_room(&self, length: usize, deadline: Time) {
        match self {
            Self::Socket(writer) => writer.await_room(deadline),
            Self::Ring(writer) => writer.await_room(length, deadline.since(Time::now())),
        }
    }

    /// Announces that a task waits for room for `length` bytes.
    pub(super) fn arm(&self, length: usize) -> Armed {
        match self {
            Self::Socket(_) => Armed::Ready,
            Self::Ring(writer) => writer.arm(length),
        }
    }

    /// Says that it is awake.
    pub(super) fn disarm(&self) {
        match self {
            Self::Socket(_) => {}
            Self::Ring(writer) => writer.disarm(),
        }
    }

    /// Writes one frame if there is room for it now, and the link is one of rings.
    pub(super) fn try_write(&self, message: &Message) -> bool {
        match self {
            Self::Socket(_) => false,
            // An error shows itself again when the ring is read.
            Self::Ring(writer) => writer.try_write(message).unwrap_or(false),
        }
    }

    /// Writes the outcomes that found no room when they were said, as far as there is room now. Never waits.
    pub(super) fn pay(&self) {
        match self {
            Self::Socket(writer) => writer.pay(),
            Self::Ring(writer) => writer.pay(),
        }
    }

    /// Closes the connection, which gives the address back.
    pub(super) fn close(&self) {
        match self {
            Self::Socket(writer) => writer.close(),
            Self::Ring(writer) => writer.close(),
        }
    }
}

impl ReceiptSink for Writer {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        match self {
            Self::Socket(writer) => writer.settle(ticket, outcome),
            Self::Ring(writer) => writer.settle(ticket, outcome),
        }
    }
}

/// The reading half.
pub(super) enum Reader {
    Socket(socket::Reader),
    Ring(Box<ring::Reader>),
}

/// What a look at the link found.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Read {
    /// Bytes came.
    Some,
    /// Nothing came.
    Nothing,
    /// Nothing will come any more, for this reason.
    Ended(Ended),
}

/// Why a link has ended.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Ended {
    pub(super) why: String,
    /// Whether the client may register again: the fault is not its own.
    pub(super) again: bool,
}

impl Ended {
    /// What a node that is no more there says.
    fn silently() -> Self {
        Self { why: "the node closed it, or ended".to_owned(), again: true }
    }

    /// The node writes nonsense, or the system refuses.
    fn for_good(why: String) -> Self {
        Self { why, again: false }
    }
}

impl From<Refusal> for Ended {
    fn from(refusal: Refusal) -> Self {
        Self { why: refusal.sentence, again: refusal.again }
    }
}

impl Reader {
    /// The next frame of those that were read.
    pub(super) fn next(&mut self) -> Result<Option<Message>, ApiError> {
        match self {
            Self::Socket(reader) => reader.next(),
            Self::Ring(reader) => reader.next(),
        }
    }

    /// Takes nothing any more, of what is there already neither.
    pub(super) fn turn_away(&mut self) {
        match self {
            Self::Socket(reader) => reader.turn_away(),
            Self::Ring(reader) => reader.turn_away(),
        }
    }

    /// Reads what is there, without waiting.
    pub(super) fn read(&mut self, now: Time) -> Read {
        match self {
            Self::Socket(reader) => reader.read(),
            Self::Ring(reader) => reader.read(now),
        }
    }

    /// The socket beside the rings, if there are rings.
    pub(super) fn control(&self) -> Option<Arc<UnixStream>> {
        match self {
            Self::Socket(_) => None,
            Self::Ring(reader) => Some(reader.socket()),
        }
    }

    /// Whether the node was seen to be gone; what it said before can still be read.
    pub(super) fn has_ended(&mut self, now: Time) -> bool {
        match self {
            // Writing to it says so.
            Self::Socket(_) => false,
            Self::Ring(reader) => reader.has_ended(now),
        }
    }

    /// The same, looked at now.
    pub(super) fn has_ended_now(&mut self) -> bool {
        match self {
            Self::Socket(_) => false,
            Self::Ring(reader) => {
                reader.look_at_once();
                reader.has_ended(Time::now())
            }
        }
    }

    /// Waits until there is something to read, or to do, for `left` at most. May end early without a reason. One
    /// wake of the calling thread.
    pub(super) fn wait(&mut self, left: Duration) {
        match self {
            Self::Socket(reader) => reader.wait(Time::now() + left),
            Self::Ring(reader) => reader.wait(left),
        }
    }
}

/// What is asked of the node, of which the link's own part is not the caller's to fill in.
fn asked(register: &Register, transport: Transport) -> Register {
    let ring = transport == Transport::Ring && ring::is_available();
    Register { ring, waits: !register.requires.is_empty(), ..register.clone() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signals_at_a_full_door_cost_who_registers_nothing_but_its_time() {
        let interrupted = || Err(ErrorKind::Interrupted.into());
        // Given: three signals, before there is room.
        let (mut calls, mut left) = (0, Vec::new());
        let end = Time::now() + CONNECT;
        let came = whatever_signals_come(end, |within| {
            left.push(within);
            calls += 1;
            if calls <= 3 { interrupted() } else { Ok(()) }
        });
        // Then: it has come, and each try had what the others had left.
        assert!(came.is_ok());
        assert!(
            left.len() == 4 && left.is_sorted_by(|one, next| one >= next) && left[0] <= CONNECT,
            "{left:?}"
        );
        // When: its time is over. Then: it gives up, whatever comes.
        let gave_up = whatever_signals_come(Time::now(), |_| interrupted());
        assert_eq!(gave_up.unwrap_err().kind(), ErrorKind::Interrupted);
        // What else fails is told at once.
        let mut calls = 0;
        let refused = whatever_signals_come(end, |_| {
            calls += 1;
            Err(ErrorKind::ConnectionRefused.into())
        });
        assert_eq!((refused.unwrap_err().kind(), calls), (ErrorKind::ConnectionRefused, 1));
    }
}
