//! The node's end of a client's link: the plain socket, or a ring for each direction beside it.

use std::{
    io::{self, IoSlice},
    os::fd::{AsRawFd, RawFd},
    sync::Arc,
    task::{Context, Poll},
};

use sinew_protocol::{
    link_counts::{self, LinkCounts},
    ring::{self, Exchange, ExchangeError, RingError, RingFrames, Taken},
};
use sinew_runtime::wire::{Checksum, FrameError};
use sinew_session::{
    direct_links::{CountsLinks, DirectCounts, DirectReading},
    outlet::{Account, Socket},
};
use sinew_shm::{
    Armed, BellKind, Capacity, Consumer, Descriptors, LoanError, Offer, PassError, PeerCounters, Producer,
};
use tokio::{
    io::{Interest, unix::AsyncFd},
    net::UnixStream,
};

use super::{
    reader::{self, Peeked, READ_WORK, Reader, Received},
    rings::{DropElsewhere, Rings},
};

/// Reads of one client's ring before other tasks run.
const READS_PER_TURN: usize = 64;
/// Bytes read from one ring before that. One read may take more, up to twice as many or one record, and then the turn
/// ends.
const BYTES_PER_TURN: usize = 64 * 1024;
/// Waits without a frame before other tasks run.
const WAITS_PER_TURN: usize = 64;
/// Bytes read from a ring at once.
const ENOUGH: usize = 16 * 1024;

/// Reason why a link can no longer be read.
#[derive(Debug, thiserror::Error)]
pub(super) enum LinkError {
    /// The data cannot be decoded.
    #[error(transparent)]
    Ring(#[from] RingError),
    #[error("the socket of a link with rings carries descriptors only, not bytes")]
    StrayBytes,
}

impl From<FrameError> for LinkError {
    fn from(error: FrameError) -> Self {
        Self::Ring(error.into())
    }
}

/// The node's half of a client's rings, which no other party has yet.
pub(super) struct RingHalf {
    exchange: DropElsewhere<Exchange>,
    offer: Offer,
}

/// Creates the node's half of the rings. Returns `None` if the system lacks memory, which is logged once per link, or
/// if the thread `rings` has too many tasks. The caller has a deadline.
///
/// On success, `stream` accepts descriptors until the exchange is over.
pub(super) async fn prepare(
    ring_bytes: usize,
    stream: &UnixStream,
    rings: &Rings,
) -> Option<(Capacity, RingHalf)> {
    let (capacity, handle) = (ring::capacity(ring_bytes), rings.clone());
    let make = move || {
        let (exchange, offer) = Exchange::prepare(capacity, BellKind::Socket)?;
        Ok::<_, ExchangeError>(RingHalf { exchange: handle.keep(exchange), offer })
    };
    match rings.run(make).await? {
        Ok(half) => {
            // Before the client learns that it may offer its half. If the kernel lacks this option, descriptors are
            // accepted anyway.
            let _ = sinew_shm::set_descriptors(stream, Descriptors::Taken);
            Some((capacity, half))
        }
        Err(why) => {
            sinew_runtime::log::warn!(%why, "a client that asked for rings gets a plain socket");
            None
        }
    }
}

/// Exchanges offers with the client. Ends with its offer, or never; the caller has a deadline.
pub(super) async fn exchange(
    half: RingHalf,
    stream: &Arc<UnixStream>,
    payload_max: usize,
    rings: &Rings,
) -> Result<(ClientSocket, ClientReader, ClientCounters), ExchangeError> {
    let RingHalf { exchange, offer } = half;
    offer.send(stream)?;
    // The sent offer holds its own descriptors.
    drop(offer);
    wait_for_data(stream).await?;
    let (handle, stream) = (rings.clone(), stream.clone());
    let map = move || {
        let theirs = Exchange::take(&*stream);
        let _ = sinew_shm::set_descriptors(&*stream, Descriptors::Refused);
        // A hostile client's descriptor may take forever to close. The copies ensure that no close on this path is its
        // last one.
        let mut theirs = theirs?;
        let copies = handle.keep(theirs.copies());
        // This side's bells are not closed here either: the client may have passed descriptors through them since they
        // were offered.
        let theirs = exchange.accept(theirs.into_offer()?)?;
        // All of it is in use, so closing a copy cannot block.
        drop(copies.into_inner());
        let (producer, consumer) = exchange.into_inner().join(theirs);
        Ok::<_, ExchangeError>((handle.keep(producer), handle.keep(consumer)))
    };
    let (producer, consumer) = rings.run(map).await.ok_or(ExchangeError::Fault)??;
    let counters = ClientCounters(rings.keep(producer.peer_counters()));
    let socket = RingSocket { producer: watch(Out(producer))?, wanted: 0, written: 0 };
    let consumer = watch(In(consumer))?;
    let frames = RingFrames::new(payload_max);
    let reader = RingReader { consumer, frames, reads: 0, bytes: 0, waits: 0, idle: 0, has_hung_up: false };
    Ok((ClientSocket::Ring(socket), ClientReader::Ring(reader), counters))
}

/// The counters of a client, in its own memory.
pub(super) struct ClientCounters(DropElsewhere<PeerCounters>);

impl CountsLinks for ClientCounters {
    fn read(&self) -> DirectReading {
        let of = |LinkCounts { sent, superseded, taken }| DirectCounts { sent, superseded, taken };
        let (links, ended) = link_counts::read(&self.0.read());
        DirectReading {
            links: links.into_iter().map(|(peer, counts)| (peer.app, of(counts))).collect(),
            ended: of(ended),
        }
    }
}

/// Resolves when the client has sent data, or has closed. Reads none of it, since another thread must close the
/// descriptors beside it.
async fn wait_for_data(stream: &UnixStream) -> Result<(), ExchangeError> {
    loop {
        stream.readable().await.map_err(PassError::System)?;
        match stream.try_io(Interest::READABLE, || reader::peek(stream, &mut [0])) {
            Ok(_) => return Ok(()),
            Err(cause) if cause.kind() == io::ErrorKind::WouldBlock => {}
            Err(cause) => return Err(PassError::System(cause).into()),
        }
    }
}

/// Registers a bell with the reactor of the calling thread.
fn watch<B: AsRawFd>(bell: B) -> Result<AsyncFd<B>, ExchangeError> {
    #[expect(
        deprecated,
        reason = "sound for the two types below, whose bell keeps its descriptor; its successor is an unsafe fn, and unsafe code lives in sinew-shm and the C binding alone"
    )]
    let watched = AsyncFd::with_interest(bell, Interest::READABLE);
    watched.map_err(|cause| PassError::System(cause).into())
}

/// The writing half.
#[expect(
    clippy::large_enum_variant,
    reason = "there is one for each connection, and a message takes no detour"
)]
pub(super) enum ClientSocket {
    Plain(Arc<UnixStream>),
    Ring(RingSocket),
}

impl Socket for ClientSocket {
    fn checksum(&self) -> Checksum {
        match self {
            Self::Plain(_) => Checksum::Crc,
            Self::Ring(_) => Checksum::None,
        }
    }

    fn try_write_vectored(&mut self, parts: &[IoSlice<'_>]) -> io::Result<usize> {
        match self {
            Self::Plain(stream) => stream.try_write_vectored(parts),
            Self::Ring(ring) => ring.try_write_vectored(parts),
        }
    }

    fn written(&self) -> u64 {
        match self {
            Self::Plain(stream) => stream.written(),
            Self::Ring(ring) => ring.written,
        }
    }

    fn account(&mut self) -> Account {
        match self {
            Self::Plain(stream) => stream.account(),
            Self::Ring(ring) => ring.account(),
        }
    }

    fn poll_writable(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        match self {
            Self::Plain(stream) => stream.poll_writable(cx),
            Self::Ring(ring) => ring.poll_writable(cx),
        }
    }
}

/// A producer with a bell for room that the reactor watches.
struct Out(DropElsewhere<Producer>);

impl AsRawFd for Out {
    fn as_raw_fd(&self) -> RawFd {
        self.0.fd().expect("a socket bell has a descriptor").as_raw_fd()
    }
}

/// A consumer with a bell for messages that the reactor watches.
struct In(DropElsewhere<Consumer>);

impl AsRawFd for In {
    fn as_raw_fd(&self) -> RawFd {
        self.0.fd().expect("a socket bell has a descriptor").as_raw_fd()
    }
}

/// The ring to a client. The writer holds the outlet's lock; no writer ever waits here.
pub(super) struct RingSocket {
    producer: AsyncFd<Out>,
    /// Size of the record that found no room.
    wanted: usize,
    /// Total number of ring bytes used so far.
    written: u64,
}

impl RingSocket {
    fn try_write_vectored(&mut self, parts: &[IoSlice<'_>]) -> io::Result<usize> {
        let producer = &mut self.producer.get_mut().0;
        let before = producer.published();
        let written = ring::write(producer, parts);
        self.written += u64::from(producer.published().wrapping_sub(before));
        written.map_err(|error| match error {
            LoanError::Full { asked, .. } => {
                self.wanted = asked;
                io::ErrorKind::WouldBlock.into()
            }
            error @ (LoanError::TooLong { .. } | LoanError::Corrupt(_)) => corrupt(error),
        })
    }

    fn account(&mut self) -> Account {
        let written = self.written;
        // If the peer writes an invalid position, its progress is unknown.
        let undelivered = self.producer.get_mut().0.unread().unwrap_or(0);
        Account { written, taken: written - u64::from(undelivered) }
    }

    fn poll_writable(&mut self, cx: &mut Context<'_>) -> Poll<io::Result<()>> {
        loop {
            match self.producer.get_mut().0.arm(self.wanted) {
                Ok(Armed::Ready) => return Poll::Ready(Ok(())),
                Ok(Armed::Sleep) => {}
                Err(error) => return Poll::Ready(Err(corrupt(error))),
            }
            let Poll::Ready(rung) = self.producer.poll_read_ready_mut(cx) else { return Poll::Pending };
            let mut rung = rung?;
            if rung.ready().is_read_closed() {
                return Poll::Ready(Err(io::ErrorKind::BrokenPipe.into()));
            }
            rung.clear_ready();
            rung.get_inner_mut().0.disarm();
        }
    }
}

impl Drop for RingSocket {
    fn drop(&mut self) {
        // Wakes a sleeping client, which then sees that its socket has hung up.
        self.producer.get_ref().0.ring();
    }
}

fn corrupt(error: LoanError) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, format!("shared memory holds what it cannot: {error}"))
}

/// The reading half.
#[expect(clippy::large_enum_variant, reason = "as above")]
pub(super) enum ClientReader {
    Plain(Reader),
    Ring(RingReader),
}

impl ClientReader {
    /// Returns the next event. This future may be dropped at any time without losing a byte.
    pub(super) async fn receive(&mut self, stream: &UnixStream) -> Result<Received, LinkError> {
        match self {
            Self::Plain(reader) => Ok(reader.receive(stream).await?),
            Self::Ring(reader) => reader.receive(stream).await,
        }
    }

    /// Returns the work without a frame since the last call, in bytes.
    pub(super) fn take_idle(&mut self) -> usize {
        match self {
            Self::Plain(reader) => reader.take_idle(),
            Self::Ring(reader) => reader.frames.take_idle().saturating_add(std::mem::take(&mut reader.idle)),
        }
    }
}

/// The ring from a client.
pub(super) struct RingReader {
    consumer: AsyncFd<In>,
    frames: RingFrames,
    /// Frames and reads since other tasks ran.
    reads: usize,
    /// Bytes that these reads took.
    bytes: usize,
    /// Waits since the last frame or the last yield: a bell can ring without data.
    waits: usize,
    /// The work of these waits, in bytes.
    idle: usize,
    /// Its process is gone; its earlier data is still handled.
    has_hung_up: bool,
}

impl RingReader {
    async fn receive(&mut self, stream: &UnixStream) -> Result<Received, LinkError> {
        loop {
            // Checked before a frame is taken. spec: LNCL-16
            self.reads += 1;
            if self.reads > READS_PER_TURN || self.bytes >= BYTES_PER_TURN || self.waits > WAITS_PER_TURN {
                (self.reads, self.bytes, self.waits) = (0, 0, 0);
                return Ok(Received::Yield);
            }
            if let Some(message) = self.frames.next_message()? {
                self.waits = 0;
                return Ok(Received::Frame(message));
            }
            let consumer = &mut self.consumer.get_mut().0;
            let taken = self.frames.take(consumer, ENOUGH).map_err(RingError::from)?;
            self.bytes += self.frames.copied();
            match taken {
                Taken::Some => {}
                Taken::Nothing if self.has_hung_up => return Ok(Received::End),
                Taken::Nothing => self.wait(stream).await?,
            }
        }
    }

    /// Waits until the ring may hold data, or the peer is gone.
    async fn wait(&mut self, stream: &UnixStream) -> Result<(), LinkError> {
        if self.consumer.get_mut().0.arm().map_err(RingError::from)? == Armed::Ready {
            // No wait took place, so the turn continues. A peer that publishes its records one by one, each just now,
            // gets no longer turn by that.
            return Ok(());
        }
        (self.reads, self.bytes) = (0, 0);
        (self.waits, self.idle) = (self.waits + 1, self.idle.saturating_add(READ_WORK));
        tokio::select! {
            biased;
            rung = self.consumer.readable_mut() => match rung {
                // The bell ends with its process, like the socket.
                Ok(rung) if rung.ready().is_read_closed() => self.has_hung_up = true,
                Ok(mut rung) => rung.clear_ready(),
                Err(_) => self.has_hung_up = true,
            },
            hung_up = wait_for_hang_up(stream) => {
                hung_up?;
                self.has_hung_up = true;
            }
        }
        self.consumer.get_mut().0.disarm();
        Ok(())
    }
}

/// Resolves when the peer has closed the socket, or its process has ended.
async fn wait_for_hang_up(stream: &UnixStream) -> Result<(), LinkError> {
    loop {
        if stream.readable().await.is_err() {
            return Ok(());
        }
        // The data is not read: a descriptor may accompany it, and is closed with the socket.
        match stream.try_io(Interest::READABLE, || reader::peek(stream, &mut [0])) {
            Ok(Peeked { count: 0, .. }) => return Ok(()),
            Ok(_) => return Err(LinkError::StrayBytes),
            Err(error) if error.kind() == io::ErrorKind::WouldBlock => {}
            Err(_) => return Ok(()),
        }
    }
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use std::{os::unix::net::UnixStream as Plain, sync::mpsc::sync_channel, thread};

    use sinew_shm::OFFER_BYTES;

    use super::*;
    use crate::{
        slow_close::{self, SlowClose},
        testing::WATCHDOG,
    };

    /// Returns the node's half, for a client at the other end of the returned socket. Its bells accept descriptors, as
    /// all do before Linux 6.16.
    async fn half_for(rings: &Rings) -> (RingHalf, Arc<UnixStream>, Plain) {
        let (ours, theirs) = Plain::pair().expect("a pair");
        ours.set_nonblocking(true).expect("it is ours");
        let stream = Arc::new(UnixStream::from_std(ours).expect("it is a socket"));
        let (_, half) = prepare(4_096, &stream, rings).await.expect("there is memory");
        for bell in half.exchange.bells().into_iter().flatten() {
            let _ = sinew_shm::set_descriptors(bell, Descriptors::Taken);
        }
        (half, stream, theirs)
    }

    // spec: LNCL-18
    #[test]
    fn refused_slow_offer_costs_no_other_rings() {
        let (report, reported) = sync_channel(1);
        let (mut first, mut second) = (SlowClose::new(), SlowClose::new());
        let passed = [&mut first, &mut second].map(|slow| slow.ours.take().expect("it is passed once"));
        thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
            runtime.block_on(async {
                // Given: a client that accepts the node's offer, and passes a descriptor in each of its bells.
                let rings = Rings::begin(1);
                let (mine, stream, client) = half_for(&rings).await;
                let client = thread::spawn(move || {
                    let theirs = Offer::receive(&client).unwrap().unwrap();
                    for (bell, passed) in theirs.descriptors()[1..].iter().zip(passed) {
                        slow_close::pass(bell, b"1", &passed).unwrap();
                    }
                    // When: its offer contains the node's own memory, and descriptors that are no bells.
                    let memory = theirs.descriptors()[0].try_clone().unwrap();
                    let others = [(); 2].map(|()| theirs.descriptors()[0].try_clone().unwrap());
                    let offer = [memory].into_iter().chain(others).collect();
                    let bytes: [u8; OFFER_BYTES] = theirs.to_bytes();
                    Offer::from_parts(&bytes, offer).unwrap().send(&client).unwrap();
                    client
                });
                let refused = exchange(mine, &stream, 4_096, &rings).await;
                assert!(matches!(refused, Err(ExchangeError::Refused(_))));
                // Then: another client gets rings.
                let next = half_for(&rings).await;
                // The test may have ended before this.
                let _ = report.send(());
                drop((next, client.join()));
            });
        });
        assert_eq!(reported.recv_timeout(WATCHDOG), Ok(()));
        [first, second].into_iter().for_each(SlowClose::release);
    }
}
