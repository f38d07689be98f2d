//! The connection to the node: whole frames out, bytes in, each with a bound on the wait. It has two
//! transports: a plain socket, or a shared-memory ring in each direction with a socket that signals the
//! node's end.

mod handshake;
pub(super) mod loan;
pub(super) mod ring;
mod server_trust;
pub(super) mod socket;
mod types;

use std::{
    io::{self, ErrorKind},
    os::{fd::OwnedFd, unix::net::UnixStream},
    path::Path,
    sync::Arc,
    time::Duration,
};

use sinew_protocol::payload::{Refusal, Register, Registered};
use sinew_runtime::{
    outcome::{Outcome, ReceiptSink, Ticket},
    time::Time,
    wire::Message,
};
use sinew_shm::{Armed, Bell, Counters, Spin, WaitSet};
use socket2::{Domain, SockAddr, Socket, Type};

use super::{
    ApiError, DirectLinks,
    loan::{Content, Draft},
};

pub(super) use handshake::RegistrationHandshake;
use loan::InRing;
pub(super) use ring::Arrived;
use ring::{Begun, Rest};
pub(super) use server_trust::{ServerTrust, UntrustedServerError};
pub(super) use types::{TypeOf, Use, UsedTypes};

/// Maximum wait for a place in the accept queue of a node, if the caller has that long.
pub(super) const CONNECT: Duration = Duration::from_secs(2);

/// The transport of an endpoint's messages to its node and back.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub enum Transport {
    /// A ring in shared memory for each direction: at most one wake per message. The reader copies each message
    /// out of the ring, to its own memory; one that came in pieces may be copied a second time. If the system or
    /// the node has no rings, the socket is used, which is logged.
    #[default]
    Ring,
    /// The unix socket alone.
    Socket,
}

/// The settings of a link.
#[derive(Clone, Debug)]
pub(super) struct LinkOptions {
    pub(super) transport: Transport,
    pub(super) spin: Spin,
    /// How long a send waits for room.
    pub(super) stall_timeout: Duration,
    /// The wake-up method of this side: a set of all rings of the endpoint if a thread waits, one socket per link if a
    /// task does.
    pub(super) bell: Bell,
    /// When the endpoint has direct links.
    pub(super) direct_links: DirectLinks,
    /// Bytes of this side's ring of a direct link.
    pub(super) direct_ring_bytes: usize,
    /// The processes that each connection trusts as the node.
    pub(super) server_trust: ServerTrust,
    /// The types that each connection declares to the node.
    pub(super) types: UsedTypes,
}

impl LinkOptions {
    /// The set of all rings of the endpoint, if it has one.
    pub(super) const fn set(&self) -> Option<&WaitSet> {
        match &self.bell {
            Bell::Set(set) => Some(set),
            Bell::OfItsOwn(_) => None,
        }
    }
}

/// A registered link.
pub(super) struct Link {
    pub(super) registered: Registered,
    pub(super) writer: Arc<Writer>,
    pub(super) reader: Reader,
}

/// Connects to the node that listens at `path`, if it is trusted, until `deadline` at most.
pub(super) fn connect(
    path: &Path,
    server_trust: ServerTrust,
    deadline: Time,
) -> Result<UnixStream, ApiError> {
    // For the system a zero timeout means no timeout.
    let least = Duration::from_millis(1);
    let within = deadline.since(Time::now()).clamp(least, CONNECT);
    let end = Time::now() + within;
    let address = address_of(path)?;
    let try_to = || -> io::Result<UnixStream> {
        let socket = Socket::new(Domain::UNIX, Type::STREAM, None)?;
        retry_interrupted(end, |left| {
            // Linux bounds a unix socket's `connect` by the send timeout.
            socket.set_write_timeout(Some(left.max(least)))?;
            socket.connect(&address)
        })?;
        socket.set_nonblocking(true)?;
        let stream = UnixStream::from(OwnedFd::from(socket));
        server_trust.check(&stream)?;
        Ok(stream)
    };
    try_to().map_err(|cause| {
        if matches!(cause.kind(), ErrorKind::WouldBlock | ErrorKind::TimedOut | ErrorKind::Interrupted) {
            // A process listens but accepts no connection.
            return ApiError::NoAnswer(within);
        }
        ApiError::NoNode { path: path.to_owned(), cause }
    })
}

/// Calls `call` with the time left, and repeats it until `end` if a signal interrupts it.
fn retry_interrupted(end: Time, mut call: impl FnMut(Duration) -> io::Result<()>) -> io::Result<()> {
    loop {
        match call(end.since(Time::now())) {
            Err(cause) if cause.kind() == ErrorKind::Interrupted && Time::now() < end => {}
            result => return result,
        }
    }
}

fn address_of(path: &Path) -> Result<SockAddr, ApiError> {
    let not_a_path = |why| ApiError::NotAPath { path: path.to_owned(), why };
    if path.as_os_str().is_empty() {
        // For the system that is a socket without a name.
        return Err(not_a_path("it is empty"));
    }
    SockAddr::unix(path).map_err(|_| not_a_path("it has more than 107 bytes, or a zero among them"))
}

/// The progress of writing a frame.
pub(super) enum Progress {
    Whole,
    /// The rest is in this value, or with the writer itself.
    Part(Option<Rest>),
    /// Nothing of the frame was written.
    Full(Message),
}

/// The writing half. Any thread that settles a message writes to it.
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

    /// Writes one of the layers' own frames, which are all short; waits for room for at most the link's stall
    /// timeout.
    pub(super) fn write(&self, message: &Message) -> Result<(), ApiError> {
        match self {
            Self::Socket(writer) => writer.write(message),
            Self::Ring(writer) => writer.write(message),
        }
    }

    /// Returns the counters of this side that the node can read.
    pub(super) fn counters(&self) -> Option<Counters> {
        match self {
            Self::Socket(_) => None,
            Self::Ring(writer) => writer.counters(),
        }
    }

    /// Lends room for a payload of `length` bytes in the memory of the transport, or returns `None` if there
    /// is none now.
    pub(super) fn lend(&self, length: usize) -> Option<InRing> {
        match self {
            Self::Socket(_) => None,
            Self::Ring(writer) => writer.lend(length),
        }
    }

    /// Sends a draft in place if its payload is in this very ring; otherwise returns it as a message.
    pub(super) fn send_in_place(&self, draft: Draft) -> Option<Message> {
        match (self, draft.payload) {
            (Self::Ring(writer), Content::InRing(mut loan)) if loan.is_of(writer) => {
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

    /// Returns whether the last frame was written in part and the writer itself has the rest.
    pub(super) fn is_within_frame(&self) -> bool {
        match self {
            Self::Socket(writer) => writer.has_pending(),
            Self::Ring(_) => false,
        }
    }

    /// Returns whether outcomes wait for room.
    pub(super) fn has_pending(&self) -> bool {
        match self {
            Self::Socket(writer) => writer.has_pending(),
            Self::Ring(writer) => writer.has_pending(),
        }
    }

    /// Resolves when another thread has left an outcome that waits for room, or has called
    /// [`wake_task`](Self::wake_task).
    pub(super) async fn pending_added(&self) {
        match self {
            Self::Socket(writer) => writer.pending_notify.notified().await,
            Self::Ring(writer) => writer.pending_notify.notified().await,
        }
    }

    /// Ends the wait of the endpoint's task, or its next one.
    pub(super) fn wake_task(&self) {
        match self {
            Self::Socket(writer) => writer.pending_notify.notify_one(),
            Self::Ring(writer) => writer.pending_notify.notify_one(),
        }
    }

    /// Returns the node's read counter.
    pub(super) fn taken(&self) -> u32 {
        match self {
            Self::Socket(writer) => writer.taken(),
            Self::Ring(writer) => writer.taken(),
        }
    }

    /// Waits until there may be room for a frame of `length` bytes, until the node's end, or until
    /// `deadline`.
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

    /// Records that the task is awake.
    pub(super) fn disarm(&self) {
        match self {
            Self::Socket(_) => {}
            Self::Ring(writer) => writer.disarm(),
        }
    }

    /// Writes one frame if there is room for it now and the transport is a ring.
    pub(super) fn try_write(&self, message: &Message) -> bool {
        match self {
            Self::Socket(_) => false,
            // The error appears again when the ring is read.
            Self::Ring(writer) => writer.try_write(message).unwrap_or(false),
        }
    }

    /// Writes the outcomes that found no room earlier, as far as there is room now. Never waits.
    pub(super) fn flush_pending(&self) {
        match self {
            Self::Socket(writer) => writer.flush_pending(),
            Self::Ring(writer) => writer.flush_pending(),
        }
    }

    /// Closes the connection, which releases the address.
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

/// The result of reading the link.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Read {
    /// Bytes have arrived.
    Some,
    /// Nothing has arrived.
    Nothing,
    /// No more data will arrive, for this reason.
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
    /// Returns the reason for a node that ended without a report.
    fn without_reason() -> Self {
        Self { why: "the node closed it, or ended".to_owned(), again: true }
    }

    /// Returns the reason for invalid data of the node, or a failure of the system.
    fn permanent(why: String) -> Self {
        Self { why, again: false }
    }
}

impl From<Refusal> for Ended {
    fn from(refusal: Refusal) -> Self {
        Self { why: refusal.sentence, again: refusal.again }
    }
}

impl Reader {
    /// Returns the next frame of those that were read.
    pub(super) fn next(&mut self) -> Result<Option<Message>, ApiError> {
        match self {
            Self::Socket(reader) => reader.next(),
            Self::Ring(reader) => reader.next(),
        }
    }

    /// Returns whether a frame was read that [`next`](Self::next) has not returned.
    pub(super) fn has_frame(&self) -> bool {
        match self {
            Self::Socket(reader) => reader.has_frame(),
            Self::Ring(reader) => reader.has_frame(),
        }
    }

    /// Stops reading, including data that has arrived already.
    pub(super) fn stop_reading(&mut self) {
        match self {
            Self::Socket(reader) => reader.stop_reading(),
            Self::Ring(reader) => reader.stop_reading(),
        }
    }

    /// Looks what has arrived on this ring and on those of direct links. Returns `None` if one look does not show that.
    pub(super) fn look(&self, now: Time) -> Option<Arrived> {
        match self {
            Self::Socket(_) => None,
            Self::Ring(reader) => reader.look_at_set(now),
        }
    }

    /// Returns what the last look has found.
    pub(super) fn found(&self, now: Time) -> Option<Arrived> {
        match self {
            Self::Socket(_) => None,
            Self::Ring(reader) => reader.found(now),
        }
    }

    /// Returns whether a read would find nothing, if one look shows that.
    pub(super) fn is_empty(&self, now: Time) -> bool {
        match self {
            Self::Socket(_) => false,
            Self::Ring(reader) => reader.is_empty(now),
        }
    }

    /// Reads the data that has arrived, without waiting.
    pub(super) fn read(&mut self, now: Time) -> Read {
        match self {
            Self::Socket(reader) => reader.read(),
            Self::Ring(reader) => reader.read(now),
        }
    }

    /// Returns the socket in addition to the rings, if there are rings.
    pub(super) fn control(&self) -> Option<Arc<UnixStream>> {
        match self {
            Self::Socket(_) => None,
            Self::Ring(reader) => Some(reader.socket()),
        }
    }

    /// Returns whether the node's end was observed; data sent before can still be read.
    pub(super) fn has_ended(&mut self, now: Time) -> bool {
        match self {
            // A write to it reports that.
            Self::Socket(_) => false,
            Self::Ring(reader) => reader.has_ended(now),
        }
    }

    /// The same, checked now.
    pub(super) fn has_ended_now(&mut self) -> bool {
        match self {
            Self::Socket(_) => false,
            Self::Ring(reader) => {
                reader.check_at_once();
                reader.has_ended(Time::now())
            }
        }
    }

    /// Waits until there is something to read or to do, for `left` at most. May return early without a
    /// reason. One wake of the calling thread.
    pub(super) fn wait(&mut self, left: Duration) {
        match self {
            Self::Socket(reader) => reader.wait(Time::now() + left),
            Self::Ring(reader) => reader.wait(left),
        }
    }
}

/// Returns the registration to send, with the fields of the link itself filled in.
fn asked(register: &Register, options: &LinkOptions) -> Register {
    let ring = options.transport == Transport::Ring && ring::is_available();
    let direct = options.direct_links.accepts();
    Register { ring, direct, waits: !register.requires.is_empty(), ..register.clone() }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn signals_at_full_backlog_do_not_fail_registration() {
        let interrupted = || Err(ErrorKind::Interrupted.into());
        // Given: three signals, before there is room.
        let (mut calls, mut left) = (0, Vec::new());
        let end = Time::now() + CONNECT;
        let result = retry_interrupted(end, |within| {
            left.push(within);
            calls += 1;
            if calls <= 3 { interrupted() } else { Ok(()) }
        });
        // Then: it has connected, and each try had the time that the previous ones had left.
        assert!(result.is_ok());
        assert!(
            left.len() == 4 && left.is_sorted_by(|one, next| one >= next) && left[0] <= CONNECT,
            "{left:?}"
        );
        // When: its time is over. Then: it gives up despite further signals.
        let gave_up = retry_interrupted(Time::now(), |_| interrupted());
        assert_eq!(gave_up.unwrap_err().kind(), ErrorKind::Interrupted);
        // Other failures are reported at once.
        let mut calls = 0;
        let refused = retry_interrupted(end, |_| {
            calls += 1;
            Err(ErrorKind::ConnectionRefused.into())
        });
        assert_eq!((refused.unwrap_err().kind(), calls), (ErrorKind::ConnectionRefused, 1));
    }
}
