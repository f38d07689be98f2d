//! The reading half of a connection: decodes frames from bytes, a bounded number at a time.

mod dial_addresses;

use std::{
    io,
    sync::{
        Arc, Mutex,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use bytes::{BufMut as _, BytesMut};
use futures_util::{Stream, stream};
use sinew_runtime::{
    lock,
    tid::AppAddress,
    time::Time,
    wire::{Checksum, FrameCodec, FrameError, HeaderError, Kind, Message},
};
use sinew_security::Peer;
use socket2::SockRef;
use tokio::net::{TcpSocket, TcpStream};
use tokio_util::codec::Decoder;

use super::{
    authenticator::{self, AuthError, Authenticator, TlsRole},
    core::{ConnectionId, HANDSHAKE_PAYLOAD_MAX, RefusalError},
    inbound::Inbound,
    peer_session::FramesBehind,
    task::{ReadingTask, Relocation, TaskThread},
    transport::{ReadResult, Transport},
};

pub(super) use dial_addresses::DialAddresses;

/// Frames processed before other tasks of the thread run.
const FRAMES_PER_WAKE: usize = 64;
/// Bytes requested from the kernel per read, on a link; up to [`BYTES_PER_TURN`] if as many arrive.
const READ_LEN: usize = 16 << 10;
/// Bytes read from one connection before other tasks run, however long its frames are: about 20 us of copying
/// and checking.
const BYTES_PER_TURN: usize = 64 << 10;
/// First pause after [`BYTES_PER_TURN`] bytes of a refused connection; it doubles each time. A peer that
/// keeps sending soon waits, and costs only the kernel's buffer. A yield would not be enough, because the
/// layer polls its connections again while one of them is ready.
const REFUSED_PAUSE: Duration = Duration::from_millis(1);
/// Longest of these pauses: 1 MiB a second per connection.
const REFUSED_PAUSE_MAX: Duration = Duration::from_millis(64);

/// Maximum number of bytes that the kernel accepts and cannot send at once: about 0.5 ms of a gigabit.
#[cfg(target_os = "linux")]
const NOT_SENT_MAX: u32 = 64 << 10;

/// An event of a connection for the shell.
#[derive(Debug)]
pub(super) struct ConnectionEvent {
    pub(super) connection: ConnectionId,
    pub(super) kind: EventKind,
}

#[derive(Debug)]
pub(super) enum EventKind {
    /// The dial succeeded, with the authenticated peer if authentication is enabled.
    Connected(Transport, Option<Box<Peer>>),
    /// The dialler has authenticated.
    Authenticated(Transport, Box<Peer>),
    /// The dialler's authentication has failed.
    AuthFailed(AuthError),
    /// The dial failed.
    DialFailed(io::Error),
    /// A frame of GNCL itself.
    Frame(Message),
    /// Messages are exchanged on this link, in either direction. Reported once.
    TrafficSeen,
    /// Invalid bytes arrived.
    Violated(RefusalError),
    /// The peer closed the connection, or it failed.
    Ended,
}

/// How the frames of a connection are handled.
pub(super) enum Mode {
    /// The shell gets them, one by one.
    Handshake,
    /// They are messages of this peer, and the connection is read by another task from now on.
    Relocate(Inbound, Relocation),
    /// They are messages of this peer.
    Linked(Inbound),
    /// They are dropped: the peer was refused and may still be sending.
    Discard,
}

/// The mode, set by the shell while it handles the connection's event, before the next frame is decoded.
pub(super) type SharedMode = Arc<Mutex<Mode>>;

/// Time of the last read of the peer's messages, in nanoseconds; 0: never. The shell reads it on demand, and
/// is not woken for it.
#[derive(Clone, Debug, Default)]
pub(super) struct LastReceived(Arc<AtomicU64>);

impl LastReceived {
    // SYNC: Relaxed, here and below; no other data is published with it.
    fn record(&self, now: Time) {
        self.0.store(now.as_nanos(), Ordering::Relaxed);
    }

    pub(super) fn last(&self) -> Time {
        Time::from_nanos(self.0.load(Ordering::Relaxed))
    }
}

/// Dials, then reads.
pub(super) fn dial(
    connection: ConnectionId,
    addresses: DialAddresses,
    reading: ReaderConfig,
) -> impl Stream<Item = ConnectionEvent> {
    events(connection, State::Dialling(addresses, reading))
}

/// Reads from an accepted socket.
pub(super) fn read(
    connection: ConnectionId,
    transport: Transport,
    reading: ReaderConfig,
) -> impl Stream<Item = ConnectionEvent> {
    let state = match reading.authenticator {
        Some(_) => State::Accepted(transport, reading),
        None => State::Reading(Reader::new(transport, reading)),
    };
    events(connection, state)
}

/// Parameters of reading a connection.
pub(super) struct ReaderConfig {
    pub(super) mode: SharedMode,
    pub(super) last_received: LastReceived,
    /// Longest payload on a link, in bytes.
    pub(super) payload_max: usize,
    /// See [`tune`].
    pub(super) give_up: Duration,
    /// Mutual authentication; `None` if it is disabled.
    pub(super) authenticator: Option<Arc<Authenticator>>,
}

enum State {
    Dialling(DialAddresses, ReaderConfig),
    Accepted(Transport, ReaderConfig),
    Reading(Reader),
    Linked(ReadingTask),
    Over,
}

fn events(connection: ConnectionId, state: State) -> impl Stream<Item = ConnectionEvent> {
    stream::unfold(state, move |state| async move {
        let (kind, state) = match state {
            State::Dialling(addresses, reading) => match reach(addresses, &reading).await {
                Ok((transport, peer)) => (
                    EventKind::Connected(transport.clone(), peer),
                    State::Reading(Reader::new(transport, reading)),
                ),
                Err(error) => (EventKind::DialFailed(error), State::Over),
            },
            State::Accepted(transport, reading) => authenticate(transport, reading).await,
            State::Reading(mut reader) => match reader.next().await {
                Some(kind) => (kind, State::Reading(reader)),
                None => match reader.into_task() {
                    Some(task) => next_of_task(task).await,
                    None => (EventKind::Ended, State::Over),
                },
            },
            State::Linked(task) => next_of_task(task).await,
            State::Over => return None,
        };
        Some((ConnectionEvent { connection, kind }, state))
    })
}

async fn next_of_task(task: ReadingTask) -> (EventKind, State) {
    match task.next().await {
        Some((kind, task)) => (kind, State::Linked(task)),
        None => (EventKind::Ended, State::Over),
    }
}

/// Connects, and authenticates both sides.
async fn reach(
    addresses: DialAddresses,
    reading: &ReaderConfig,
) -> io::Result<(Transport, Option<Box<Peer>>)> {
    let transport = Transport::plain(connect(addresses, reading.give_up).await?);
    let Some(authenticator) = &reading.authenticator else { return Ok((transport, None)) };
    let (transport, peer) = authenticator.authenticate(transport, TlsRole::Client).await?;
    Ok((transport, Some(peer)))
}

async fn authenticate(transport: Transport, reading: ReaderConfig) -> (EventKind, State) {
    let Some(authenticator) = &reading.authenticator else { return (EventKind::Ended, State::Over) };
    match authenticator.authenticate(transport.clone(), TlsRole::Server).await {
        Ok((transport, peer)) => (
            EventKind::Authenticated(transport.clone(), peer),
            State::Reading(Reader::new(transport, reading)),
        ),
        // The peer gets a refusal. Its further frames are discarded until it closes the connection.
        Err(AuthError::NotTls) => {
            (EventKind::AuthFailed(AuthError::NotTls), State::Reading(Reader::new(transport, reading)))
        }
        Err(error) => (EventKind::AuthFailed(error), State::Over),
    }
}

pub(super) async fn connect(addresses: DialAddresses, give_up: Duration) -> io::Result<TcpStream> {
    let socket = if addresses.to.is_ipv6() { TcpSocket::new_v6() } else { TcpSocket::new_v4() }?;
    if let Some(from) = addresses.from {
        // If the address was removed since, the system chooses.
        let _ = socket.bind((from, 0).into());
    }
    if let Some(longest) = addresses.segment_max {
        // If the system refuses the value, the connection keeps its default.
        let _ = SockRef::from(&socket).set_tcp_mss(longest);
    }
    let socket = socket.connect(addresses.to).await?;
    tune(&socket, give_up)?;
    Ok(socket)
}

/// Sets the options of every connection between nodes. The system ends a connection when the peer's host has
/// not accepted written bytes, or not answered, for `give_up`. This includes a failure of one direction while
/// the peer's frames still arrive.
pub(super) fn tune(socket: &TcpStream, give_up: Duration) -> io::Result<()> {
    socket.set_nodelay(true)?;
    #[cfg(target_os = "linux")]
    SockRef::from(socket).set_tcp_user_timeout(Some(give_up))?;
    #[cfg(not(target_os = "linux"))]
    let _ = give_up;
    // Control cannot overtake bytes in the kernel's buffer, and newer values cannot supersede them. The
    // kernel therefore buffers little that it cannot send yet, and the rest stays in the outlet's queue.
    #[cfg(target_os = "linux")]
    SockRef::from(socket).set_tcp_notsent_lowat(NOT_SENT_MAX)?;
    Ok(())
}

/// Writes one frame to a connection that is not a link.
pub(super) async fn write_frame(mut transport: Transport, message: &Message) -> io::Result<()> {
    let mut bytes = BytesMut::with_capacity(message.size());
    // A peer without guards reads this frame, too, because no peer checks its sequence. spec: FRAME-3.1
    bytes.put_slice(&Checksum::Guarded.encode(&message.header, &message.payload));
    bytes.put_slice(&message.payload);
    transport.write_all(&bytes).await
}

pub(super) struct Reader {
    transport: Transport,
    buffer: BytesMut,
    codec: FrameCodec,
    reading: ReaderConfig,
    thread: TaskThread,
    /// Whether the peer's first frame, an ACK, has arrived.
    first_frame_seen: bool,
    /// Whether the shell was notified that messages are exchanged.
    traffic_seen: bool,
    /// Bytes read in this turn. With TLS these are the encrypted bytes, with a minimum per record.
    turn: usize,
    /// Next pause of a refused connection.
    pause: Duration,
    /// Bytes of the next read, on a link: more after a full read.
    next_read_len: usize,
    /// Whether the last read was full, so that more bytes have probably arrived.
    read_was_full: bool,
    /// Whether the end was already reported with its reason.
    is_over: bool,
}

/// The result of decoding the buffer.
enum Decoded {
    Event(EventKind),
    Again,
    Relocate,
    /// More bytes are needed.
    Empty(NextRead),
}

/// The next read of a connection, by its mode.
#[derive(Clone, Copy)]
struct NextRead {
    /// Bytes requested from the kernel.
    length: usize,
    /// Whether the peer was refused.
    is_refused: bool,
}

impl Reader {
    fn new(transport: Transport, reading: ReaderConfig) -> Self {
        Self {
            transport,
            buffer: BytesMut::new(),
            codec: FrameCodec::new(HANDSHAKE_PAYLOAD_MAX),
            reading,
            thread: TaskThread::Io,
            first_frame_seen: false,
            traffic_seen: false,
            turn: 0,
            pause: REFUSED_PAUSE,
            next_read_len: READ_LEN,
            read_was_full: false,
            is_over: false,
        }
    }

    /// Returns the next event for the shell; `None` when the connection has ended, or
    /// [continues in a task](Self::into_task).
    pub(super) async fn next(&mut self) -> Option<EventKind> {
        loop {
            match self.decode_buffer() {
                Decoded::Event(kind) => return Some(kind),
                Decoded::Again => self.yield_turn().await,
                Decoded::Relocate => return None,
                Decoded::Empty(next) => match self.fill(next).await {
                    Ok(()) => {}
                    // The bytes were not encrypted by the peer, or report that it does not accept this node.
                    Err(error) if error.kind() == io::ErrorKind::InvalidData => {
                        let why = AuthError::Rejected(error.to_string());
                        return (!std::mem::replace(&mut self.is_over, true))
                            .then_some(EventKind::AuthFailed(why));
                    }
                    Err(_) => return None,
                },
            }
        }
    }

    /// Continues in a separate task, if that was ordered.
    fn into_task(self) -> Option<ReadingTask> {
        let mut mode = lock(&self.reading.mode);
        let to = match std::mem::replace(&mut *mode, Mode::Discard) {
            Mode::Relocate(inbound, to) => {
                *mode = Mode::Linked(inbound);
                to
            }
            stays @ (Mode::Handshake | Mode::Linked(_) | Mode::Discard) => {
                *mode = stays;
                return None;
            }
        };
        drop(mode);
        let Relocation { thread, transport } = to;
        Some(ReadingTask::begin(Self { transport, thread: thread.clone(), ..self }, &thread))
    }

    fn decode_buffer(&mut self) -> Decoded {
        let mode = lock(&self.reading.mode);
        let (payload_max, checksum, length) = match &*mode {
            Mode::Handshake => (HANDSHAKE_PAYLOAD_MAX, Checksum::Crc, HANDSHAKE_PAYLOAD_MAX),
            // GNCL's own frames are never longer than in a handshake, and independent of the limit for
            // messages: see `longest`.
            Mode::Linked(inbound) => {
                let payload_max = self.reading.payload_max.max(HANDSHAKE_PAYLOAD_MAX);
                (payload_max, inbound.checksum, self.next_read_len)
            }
            Mode::Relocate(..) => return Decoded::Relocate,
            Mode::Discard => {
                self.buffer.clear();
                return Decoded::Empty(NextRead { length: HANDSHAKE_PAYLOAD_MAX, is_refused: true });
            }
        };
        let next = NextRead { length, is_refused: false };
        if self.buffer.is_empty() {
            return Decoded::Empty(next);
        }
        if matches!(&*mode, Mode::Handshake) && authenticator::is_tls(&self.buffer) {
            return Decoded::Event(EventKind::Violated(RefusalError::Security(
                authenticator::TLS_REFUSAL.to_owned(),
            )));
        }
        self.codec.set_payload_max(payload_max);
        self.codec.set_checksum(checksum);
        let now = Time::now();
        let behind = if self.read_was_full { FramesBehind::Likely } else { FramesBehind::None };
        let linked = if let Mode::Linked(inbound) = &*mode { Some(inbound) } else { None };
        let mut batch = linked.map(|inbound| inbound.batch(now, behind));
        for _ in 0..FRAMES_PER_WAKE {
            let message = match self.codec.decode(&mut self.buffer) {
                Ok(Some(message)) => message,
                Ok(None) => return Decoded::Empty(next),
                Err(error) => return Decoded::Event(EventKind::Violated(decline(&error))),
            };
            let Some(inbound) = linked else { return Decoded::Event(EventKind::Frame(message)) };
            let (length, limit) = (message.payload.len(), self.longest(&message));
            if length > limit {
                let error = FrameError::TooLong { length, limit };
                return Decoded::Event(EventKind::Violated(decline(&error)));
            }
            if is_for_the_shell(&message) {
                return Decoded::Event(EventKind::Frame(message));
            }
            self.reading.last_received.record(now);
            let is_link_frame = matches!(message.header.kind, Kind::GNCL_DATAGRAMS | Kind::GNCL_UNDELIVERED);
            if let Err(decline) = inbound.receive(now, message) {
                return Decoded::Event(EventKind::Violated(decline));
            }
            // The first frame is always an ACK. A later one shows that local messages arrive.
            if !is_link_frame && !self.traffic_seen && std::mem::replace(&mut self.first_frame_seen, true) {
                self.traffic_seen = true;
                return Decoded::Event(EventKind::TrafficSeen);
            }
            if self.buffer.is_empty() {
                return Decoded::Empty(next);
            }
        }
        batch.iter_mut().for_each(|batch| batch.behind = FramesBehind::Likely);
        Decoded::Again
    }

    /// Returns the longest payload of this message on a link: GNCL's own frames have a separate limit.
    fn longest(&self, message: &Message) -> usize {
        let is_link_frame =
            message.header.destination.app == AppAddress::GNCL && !message.header.kind.is_user();
        if is_link_frame { HANDSHAKE_PAYLOAD_MAX } else { self.reading.payload_max }
    }

    /// Yields to other tasks, and lets newly arrived data be read.
    async fn yield_turn(&mut self) {
        self.turn = 0;
        self.thread.end_turn();
        tokio::task::yield_now().await;
    }

    /// Receives bytes. Before it waits for them after a full read, it sends the ACK that is due.
    async fn receive(&mut self, room: usize) -> io::Result<ReadResult> {
        let mut may_be_due = std::mem::take(&mut self.read_was_full);
        let mut receive = std::pin::pin!(self.transport.receive(&mut self.buffer, room));
        std::future::poll_fn(|cx| {
            let received = receive.as_mut().poll(cx);
            if received.is_pending()
                && std::mem::take(&mut may_be_due)
                && let Mode::Linked(inbound) = &*lock(&self.reading.mode)
            {
                inbound.acknowledge_if_due();
            }
            received
        })
        .await
    }

    async fn fill(&mut self, next: NextRead) -> io::Result<()> {
        let NextRead { length, is_refused } = next;
        let left = self.buffer.capacity() - self.buffer.len();
        // A quarter of the length is enough: copying the rest of a frame for each read would cost more. A
        // larger buffer is one that the codec has created for the current frame, and is filled completely.
        if left == 0 || left < length / 4 && self.buffer.capacity() <= FrameCodec::BUFFER_KEPT {
            self.buffer.reserve(length);
        }
        if self.turn >= BYTES_PER_TURN && is_refused {
            self.turn = 0;
            let longer = (2 * self.pause).min(REFUSED_PAUSE_MAX);
            tokio::time::sleep(std::mem::replace(&mut self.pause, longer)).await;
        } else if self.turn >= BYTES_PER_TURN {
            self.yield_turn().await;
        }
        let room = (self.buffer.capacity() - self.buffer.len()).min(BYTES_PER_TURN);
        match self.receive(room).await? {
            ReadResult { count: 0, .. } => Err(io::ErrorKind::UnexpectedEof.into()),
            ReadResult { count, work } => {
                self.turn += work;
                self.read_was_full = count == room;
                self.next_read_len =
                    if count < room { READ_LEN } else { BYTES_PER_TURN.min(2 * self.next_read_len) };
                Ok(())
            }
        }
    }
}

/// Whether this message is about the link itself.
fn is_for_the_shell(message: &Message) -> bool {
    const KINDS: [Kind; 6] = [
        Kind::GNCL_HELLO,
        Kind::GNCL_WELCOME,
        Kind::GNCL_REFUSAL,
        Kind::GNCL_PING,
        Kind::GNCL_PONG,
        Kind::GNCL_GOODBYE,
    ];
    message.header.destination.app == AppAddress::GNCL && KINDS.contains(&message.header.kind)
}

fn decline(error: &FrameError) -> RefusalError {
    match error {
        FrameError::Header(HeaderError::Version { .. }) => RefusalError::Version(error.to_string()),
        FrameError::Header(_) | FrameError::TooLong { .. } | FrameError::Io(_) => {
            RefusalError::Violation(error.to_string())
        }
    }
}

#[cfg(test)]
mod tests;
