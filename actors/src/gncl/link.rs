//! The reading half of a connection: bytes become frames, a bounded number at a time.

use std::{
    cmp::Reverse,
    io,
    net::{IpAddr, Ipv6Addr, SocketAddr},
    sync::{
        Arc, Mutex,
        atomic::{AtomicU64, Ordering},
    },
    time::Duration,
};

use bytes::{BufMut as _, BytesMut};
use futures_util::{Stream, stream};
use sinew_runtime::{
    tid::AppAddress,
    time::Time,
    wire::{Checksum, FrameCodec, FrameError, HeaderError, Kind, Message},
};
use socket2::SockRef;
use tokio::net::{TcpSocket, TcpStream};
use tokio_util::codec::Decoder;

use super::{
    core::{ConnectionId, Decline, HANDSHAKE_PAYLOAD_MAX},
    inbound::Inbound,
    secure::{self, End, Secure, Unproven},
    task::{Move, Place, ReadingTask},
    transport::{Got, Transport},
};
use crate::{security::Peer, stores::lock};

/// Frames that are handled before other tasks of the thread have their turn.
const FRAMES_PER_WAKE: usize = 64;
/// Bytes that are asked of the kernel at once, on a link; up to [`BYTES_PER_TURN`] where as much comes.
const READ_LEN: usize = 16 << 10;
/// Bytes that are taken from one connection before others have their turn, however long its frames are: about 20 us of
/// copying and checking.
const BYTES_PER_TURN: usize = 64 << 10;
/// The first pause after as many bytes of one that was refused, twice as long each time: who pours on all the same soon waits, and costs
/// nothing but what the kernel holds for it. To say that others have their turn is not enough, as the layer looks at its connections again
/// and again as long as one of them has something new.
const REFUSED_REST: Duration = Duration::from_millis(1);
/// The longest of these pauses: 1 MiB a second of each.
const REFUSED_REST_MAX: Duration = Duration::from_millis(64);

/// Bytes at most that the kernel takes and cannot send at once: about 0.5 ms of a gigabit.
#[cfg(target_os = "linux")]
const NOT_SENT_MAX: u32 = 64 << 10;

/// What a connection has to say to the shell.
#[derive(Debug)]
pub(super) struct News {
    pub(super) connection: ConnectionId,
    pub(super) what: What,
}

#[derive(Debug)]
pub(super) enum What {
    /// The dial succeeded; who is there, where that is proven.
    Connected(Transport, Option<Box<Peer>>),
    /// Who dialled has proven who it is.
    Proven(Transport, Box<Peer>),
    /// Who dialled has not.
    Unproven(Unproven),
    /// The dial failed.
    DialFailed(io::Error),
    /// A frame of GNCL itself.
    Frame(Message),
    /// Messages pass on this link, one way or the other. Told once.
    Carried,
    /// Bytes came that cannot be used.
    Violated(Decline),
    /// The peer closed the connection, or it failed.
    Ended,
}

/// What is done with the frames of a connection.
pub(super) enum Mode {
    /// The shell gets them, one by one.
    Handshake,
    /// They are messages of this peer, and what comes from now on is read elsewhere, once.
    Moves(Inbound, Move),
    /// They are messages of this peer.
    Linked(Inbound),
    /// Nobody wants them: the peer was refused and may still be sending.
    Discard,
}

/// Set by the shell while it handles the news of the connection, before the next frame is looked at.
pub(super) type SharedMode = Arc<Mutex<Mode>>;

/// When messages of the peer were read last, in nanoseconds; 0: never. The shell looks when it needs to know, and is not woken for it.
#[derive(Clone, Debug, Default)]
pub(super) struct Heard(Arc<AtomicU64>);

impl Heard {
    // SYNC: Relaxed, here and below; nothing else becomes visible with it.
    fn at(&self, now: Time) {
        self.0.store(now.as_nanos(), Ordering::Relaxed);
    }

    pub(super) fn last(&self) -> Time {
        Time::from_nanos(self.0.load(Ordering::Relaxed))
    }
}

/// Where a dial goes, and from which address of this host; `None`: the system chooses.
#[derive(Clone, Copy, Debug)]
pub(super) struct Ends {
    pub(super) to: SocketAddr,
    pub(super) from: Option<IpAddr>,
    /// How long its segments may be, where that is known.
    pub(super) segment_max: Option<u32>,
}

impl Ends {
    /// To an address, from that one of `paths`, the addresses that this node announces, which is in its network. The system would take an
    /// IPv6 address that it makes for a day (RFC 8981), and the peer see a connection from where it never heard of anybody. Where no path
    /// is in that network the system knows better which one leads there; of IPv4 it takes no other.
    pub(super) fn of(to: SocketAddr, paths: &[SocketAddr]) -> Self {
        let from = match to {
            SocketAddr::V6(to) if !to.ip().is_unicast_link_local() && !to.ip().is_loopback() => {
                // Bits at the beginning that both have. A network may be smaller than its first 64: one for each link, say.
                let shared = |ip: &Ipv6Addr| (ip.to_bits() ^ to.ip().to_bits()).leading_zeros();
                let nearest = paths.iter().filter_map(|path| match path {
                    SocketAddr::V6(path) => Some((shared(path.ip()), *path.ip())),
                    SocketAddr::V4(_) => None,
                });
                let mut nearest: Vec<_> = nearest.filter(|(shared, _)| *shared >= 64).collect();
                nearest.sort_unstable_by_key(|(shared, _)| Reverse(*shared));
                match nearest[..] {
                    [(_, ip)] => Some(IpAddr::from(ip)),
                    [(first, ip), (second, _), ..] if first > second => Some(IpAddr::from(ip)),
                    // Of two that are as near the system knows which one leads there.
                    _ => None,
                }
            }
            SocketAddr::V6(_) | SocketAddr::V4(_) => None,
        };
        Self { to, from, segment_max: None }
    }
}

/// Dials, then reads.
pub(super) fn dial(connection: ConnectionId, ends: Ends, reading: Reading) -> impl Stream<Item = News> {
    news(connection, State::Dialling(ends, reading))
}

/// Reads from a socket that was accepted.
pub(super) fn read(
    connection: ConnectionId,
    transport: Transport,
    reading: Reading,
) -> impl Stream<Item = News> {
    let state = match reading.secure {
        Some(_) => State::Accepted(transport, reading),
        None => State::Reading(Reader::new(transport, reading)),
    };
    news(connection, state)
}

/// How a connection is read.
pub(super) struct Reading {
    pub(super) mode: SharedMode,
    pub(super) heard: Heard,
    /// Longest payload on a link, in bytes.
    pub(super) payload_max: usize,
    /// See [`tune`].
    pub(super) give_up: Duration,
    /// How both sides prove who they are; `None`: they do not.
    pub(super) secure: Option<Arc<Secure>>,
}

enum State {
    Dialling(Ends, Reading),
    Accepted(Transport, Reading),
    Reading(Reader),
    Linked(ReadingTask),
    Over,
}

fn news(connection: ConnectionId, state: State) -> impl Stream<Item = News> {
    stream::unfold(state, move |state| async move {
        let (what, state) = match state {
            State::Dialling(ends, reading) => match reach(ends, &reading).await {
                Ok((transport, peer)) => (
                    What::Connected(transport.clone(), peer),
                    State::Reading(Reader::new(transport, reading)),
                ),
                Err(error) => (What::DialFailed(error), State::Over),
            },
            State::Accepted(transport, reading) => greeted(transport, reading).await,
            State::Reading(mut reader) => match reader.next().await {
                Some(what) => (what, State::Reading(reader)),
                None => match reader.moves() {
                    Some(task) => linked(task).await,
                    None => (What::Ended, State::Over),
                },
            },
            State::Linked(task) => linked(task).await,
            State::Over => return None,
        };
        Some((News { connection, what }, state))
    })
}

async fn linked(task: ReadingTask) -> (What, State) {
    match task.next().await {
        Some((what, task)) => (what, State::Linked(task)),
        None => (What::Ended, State::Over),
    }
}

/// Connects, and has both sides prove who they are.
async fn reach(ends: Ends, reading: &Reading) -> io::Result<(Transport, Option<Box<Peer>>)> {
    let transport = Transport::open(connect(ends, reading.give_up).await?);
    let Some(secure) = &reading.secure else { return Ok((transport, None)) };
    let (transport, peer) = secure.greet(transport, End::Dials).await?;
    Ok((transport, Some(peer)))
}

async fn greeted(transport: Transport, reading: Reading) -> (What, State) {
    let Some(secure) = &reading.secure else { return (What::Ended, State::Over) };
    match secure.greet(transport.clone(), End::IsDialled).await {
        Ok((transport, peer)) => {
            (What::Proven(transport.clone(), peer), State::Reading(Reader::new(transport, reading)))
        }
        // It is told so, and until it hangs up what it says is thrown away.
        Err(Unproven::IsOpen) => {
            (What::Unproven(Unproven::IsOpen), State::Reading(Reader::new(transport, reading)))
        }
        Err(unproven) => (What::Unproven(unproven), State::Over),
    }
}

pub(super) async fn connect(ends: Ends, give_up: Duration) -> io::Result<TcpStream> {
    let socket = if ends.to.is_ipv6() { TcpSocket::new_v6() } else { TcpSocket::new_v4() }?;
    if let Some(from) = ends.from {
        // An address that was taken away since leaves the choice to the system.
        let _ = socket.bind((from, 0).into());
    }
    if let Some(longest) = ends.segment_max {
        // What the system does not take leaves the connection as it is.
        let _ = SockRef::from(&socket).set_tcp_mss(longest);
    }
    let socket = socket.connect(ends.to).await?;
    tune(&socket, give_up)?;
    Ok(socket)
}

/// Sets what every connection between nodes has. The system ends it when the peer's has taken nothing of what was written for
/// `give_up`, or has not answered for so long: also where only one direction is cut, and the peer can still be heard.
pub(super) fn tune(socket: &TcpStream, give_up: Duration) -> io::Result<()> {
    socket.set_nodelay(true)?;
    #[cfg(target_os = "linux")]
    SockRef::from(socket).set_tcp_user_timeout(Some(give_up))?;
    #[cfg(not(target_os = "linux"))]
    let _ = give_up;
    // What the kernel holds cannot be overtaken by Control nor superseded by a newer value: it shall hold little that
    // it cannot send yet, and leave the rest to the outlet's queue.
    #[cfg(target_os = "linux")]
    SockRef::from(socket).set_tcp_notsent_lowat(NOT_SENT_MAX)?;
    Ok(())
}

/// Writes one frame to a connection that is not a link.
pub(super) async fn write_frame(mut transport: Transport, message: &Message) -> io::Result<()> {
    let mut bytes = BytesMut::with_capacity(message.size());
    // Whoever knows no guard reads it, too: nobody looks at its sequence. spec: FRAME-3.1
    bytes.put_slice(&Checksum::Guarded.encode(&message.header, &message.payload));
    bytes.put_slice(&message.payload);
    transport.write_all(&bytes).await
}

pub(super) struct Reader {
    transport: Transport,
    buffer: BytesMut,
    codec: FrameCodec,
    reading: Reading,
    place: Place,
    /// The peer has said what it takes next.
    greeted: bool,
    /// The shell knows that messages pass.
    carried: bool,
    /// Bytes that were taken since others had their turn; of a sealed connection those that came for them, and each record as some at least.
    turn: usize,
    /// The next pause of one that was refused.
    rest: Duration,
    /// Bytes that are asked for next, on a link: more where the last ones came all at once.
    asked: usize,
    /// Why it is over was said.
    is_over: bool,
}

/// How a look at the buffer ended.
enum Look {
    Tell(What),
    Again,
    Moves,
    Empty,
}

impl Reader {
    fn new(transport: Transport, reading: Reading) -> Self {
        Self {
            transport,
            buffer: BytesMut::new(),
            codec: FrameCodec::new(HANDSHAKE_PAYLOAD_MAX),
            reading,
            place: Place::Here,
            greeted: false,
            carried: false,
            turn: 0,
            rest: REFUSED_REST,
            asked: READ_LEN,
            is_over: false,
        }
    }

    /// What the shell must know next; `None` when the connection has ended, or [moves](Self::moves).
    pub(super) async fn next(&mut self) -> Option<What> {
        loop {
            match self.look() {
                Look::Tell(what) => return Some(what),
                Look::Again => self.give_way().await,
                Look::Moves => return None,
                Look::Empty => match self.fill().await {
                    Ok(()) => {}
                    // What came was not sealed by the peer, or says that it does not take this node.
                    Err(error) if error.kind() == io::ErrorKind::InvalidData => {
                        let why = Unproven::NotTaken(error.to_string());
                        return (!std::mem::replace(&mut self.is_over, true)).then_some(What::Unproven(why));
                    }
                    Err(_) => return None,
                },
            }
        }
    }

    /// Goes on in a task of its own, if that was said.
    fn moves(self) -> Option<ReadingTask> {
        let mut mode = lock(&self.reading.mode);
        let to = match std::mem::replace(&mut *mode, Mode::Discard) {
            Mode::Moves(inbound, to) => {
                *mode = Mode::Linked(inbound);
                to
            }
            stays @ (Mode::Handshake | Mode::Linked(_) | Mode::Discard) => {
                *mode = stays;
                return None;
            }
        };
        drop(mode);
        let Move { place, transport } = to;
        Some(ReadingTask::begin(Self { transport, place: place.clone(), ..self }, &place))
    }

    fn look(&mut self) -> Look {
        let mode = lock(&self.reading.mode);
        let (payload_max, checksum) = match &*mode {
            Mode::Handshake => (HANDSHAKE_PAYLOAD_MAX, Checksum::Crc),
            // What GNCL itself says is never longer than in a handshake, and not bound by what messages may have: see `longest`.
            Mode::Linked(inbound) => (self.reading.payload_max.max(HANDSHAKE_PAYLOAD_MAX), inbound.checksum),
            Mode::Moves(..) => return Look::Moves,
            Mode::Discard => {
                self.buffer.clear();
                return Look::Empty;
            }
        };
        if self.buffer.is_empty() {
            return Look::Empty;
        }
        if matches!(&*mode, Mode::Handshake) && secure::is_sealed(&self.buffer) {
            return Look::Tell(What::Violated(Decline::Security(secure::SEALED_WORDS.to_owned())));
        }
        self.codec.set_payload_max(payload_max);
        self.codec.set_checksum(checksum);
        let now = Time::now();
        let _batch = if let Mode::Linked(inbound) = &*mode { Some(inbound.batch(now)) } else { None };
        for _ in 0..FRAMES_PER_WAKE {
            match (self.codec.decode(&mut self.buffer), &*mode) {
                (Ok(Some(message)), Mode::Linked(_)) if message.payload.len() > self.longest(&message) => {
                    let (said, limit) = (message.payload.len(), self.longest(&message));
                    return Look::Tell(What::Violated(decline(&FrameError::TooLong { said, limit })));
                }
                (Ok(Some(message)), Mode::Linked(inbound)) if !is_for_the_shell(&message) => {
                    self.reading.heard.at(now);
                    let is_a_word =
                        matches!(message.header.kind, Kind::GNCL_DATAGRAMS | Kind::GNCL_UNDELIVERED);
                    if let Err(decline) = inbound.receive(now, message) {
                        return Look::Tell(What::Violated(decline));
                    }
                    // The first frame is an ACK in any case. A later one says that our messages arrive.
                    if !is_a_word && !self.carried && std::mem::replace(&mut self.greeted, true) {
                        self.carried = true;
                        return Look::Tell(What::Carried);
                    }
                }
                (Ok(Some(message)), _) => return Look::Tell(What::Frame(message)),
                (Ok(None), _) => return Look::Empty,
                (Err(error), _) => return Look::Tell(What::Violated(decline(&error))),
            }
        }
        Look::Again
    }

    /// The longest payload that this may have on a link: GNCL's own words have a bound of their own, whatever messages may have.
    fn longest(&self, message: &Message) -> usize {
        let is_a_word = message.header.destination.app == AppAddress::GNCL && !message.header.kind.is_user();
        if is_a_word { HANDSHAKE_PAYLOAD_MAX } else { self.reading.payload_max }
    }

    /// Lets others have their turn, and what has come meanwhile be seen.
    async fn give_way(&mut self) {
        self.turn = 0;
        self.place.end_turn();
        tokio::task::yield_now().await;
    }

    async fn fill(&mut self) -> io::Result<()> {
        let (room, is_refused) = match *lock(&self.reading.mode) {
            Mode::Linked(_) => (self.asked, false),
            Mode::Handshake | Mode::Moves(..) => (HANDSHAKE_PAYLOAD_MAX, false),
            Mode::Discard => (HANDSHAKE_PAYLOAD_MAX, true),
        };
        let left = self.buffer.capacity() - self.buffer.len();
        // A quarter of room left is room enough: copying the rest of a frame for each read would cost more. A larger buffer
        // is one that the codec has made for the frame that is coming, and is filled to its end.
        if left == 0 || left < room / 4 && self.buffer.capacity() <= FrameCodec::BUFFER_KEPT {
            self.buffer.reserve(room);
        }
        if self.turn >= BYTES_PER_TURN && is_refused {
            self.turn = 0;
            let longer = (2 * self.rest).min(REFUSED_REST_MAX);
            tokio::time::sleep(std::mem::replace(&mut self.rest, longer)).await;
        } else if self.turn >= BYTES_PER_TURN {
            self.give_way().await;
        }
        let room = (self.buffer.capacity() - self.buffer.len()).min(BYTES_PER_TURN);
        match self.transport.take_in(&mut self.buffer, room).await? {
            Got { count: 0, .. } => Err(io::ErrorKind::UnexpectedEof.into()),
            Got { count, work } => {
                self.turn += work;
                self.asked = if count < room { READ_LEN } else { BYTES_PER_TURN.min(2 * self.asked) };
                Ok(())
            }
        }
    }
}

/// Whether this is about the link itself.
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

fn decline(error: &FrameError) -> Decline {
    match error {
        FrameError::Header(HeaderError::Version { .. }) => Decline::Version(error.to_string()),
        FrameError::Header(_) | FrameError::TooLong { .. } | FrameError::Io(_) => {
            Decline::Violation(error.to_string())
        }
    }
}

#[cfg(test)]
mod tests;
