//! The node's end of a client's link: the plain socket, or a ring each way beside it.

use std::{
    io::{self, IoSlice},
    os::fd::{AsRawFd, RawFd},
    sync::Arc,
    task::{Context, Poll},
};

use sinew_runtime::wire::{Checksum, FrameError};
use sinew_shm::{Armed, BellKind, Capacity, Consumer, Descriptors, LoanError, Offer, PassError, Producer};
use tokio::{
    io::{Interest, unix::AsyncFd},
    net::UnixStream,
};

use super::{
    reader::{self, Heard, READ_WORK, Reader, Seen},
    rings::{Kept, Rings},
};
use crate::{
    outlet::{Account, Socket},
    ring::{self, Exchange, ExchangeError, RingError, RingFrames, Taken},
};

/// Looks at one client's ring before others have their turn.
const LOOKS_A_TURN: usize = 64;
/// Bytes that are taken of it before that: a look takes more if they are there, twice as many or a record, and then the turn is over.
const BYTES_A_TURN: usize = 64 * 1024;
/// Waits without a frame before others are told to have their turn.
const WAITS_A_TURN: usize = 64;
/// Bytes that are taken from a ring at once.
const ENOUGH: usize = 16 * 1024;

/// Why a link cannot be read any more.
#[derive(Debug, thiserror::Error)]
pub(super) enum LinkError {
    /// What came cannot be read.
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

/// The node's half of a client's rings, which nobody else has yet.
pub(super) struct Half {
    exchange: Kept<Exchange>,
    offer: Offer,
}

/// Makes the node's half of the rings; `None` where the system has no memory for it, which is said once a link, or where the thread `rings`
/// has too much to do. The caller has a
/// deadline.
///
/// Where it is made, descriptors may come over `stream`, until the exchange is over.
pub(super) async fn prepare(
    ring_bytes: usize,
    stream: &UnixStream,
    rings: &Rings,
) -> Option<(Capacity, Half)> {
    let (capacity, keeper) = (ring::capacity(ring_bytes), rings.clone());
    let make = move || {
        let (exchange, offer) = Exchange::prepare(capacity, BellKind::Socket)?;
        Ok::<_, ExchangeError>(Half { exchange: keeper.keep(exchange), offer })
    };
    match rings.run(make).await? {
        Ok(half) => {
            // Before the client hears that it may offer its half. Where the system does not know it they come anyway.
            let _ = sinew_shm::set_descriptors(stream, Descriptors::Taken);
            Some((capacity, half))
        }
        Err(why) => {
            crate::log::warn!(%why, "a client that asked for rings gets a plain socket");
            None
        }
    }
}

/// Exchanges offers with the client. Ends with its offer, or never; the caller has a deadline.
pub(super) async fn exchange(
    half: Half,
    stream: &Arc<UnixStream>,
    payload_max: usize,
    rings: &Rings,
) -> Result<(ClientSocket, ClientReader), ExchangeError> {
    let Half { exchange, offer } = half;
    offer.send(stream)?;
    // On its way it has descriptors of its own.
    drop(offer);
    something_is_there(stream).await?;
    let (keeper, stream) = (rings.clone(), stream.clone());
    let map = move || {
        let theirs = Exchange::take(&*stream);
        let _ = sinew_shm::set_descriptors(&*stream, Descriptors::Refused);
        // What a hostile client has passed may take for ever to close. Whatever becomes of it here, that is not its last close.
        let mut theirs = theirs?;
        let copies = keeper.keep(theirs.copies());
        // Nor are this side's bells closed here: it may have passed something in them since they were offered.
        let theirs = exchange.accept(theirs.into_offer()?)?;
        // All of it is in use: to close a copy of it waits for nobody.
        drop(copies.into_inner());
        let (producer, consumer) = exchange.into_inner().join(theirs);
        Ok::<_, ExchangeError>((keeper.keep(producer), keeper.keep(consumer)))
    };
    let (producer, consumer) = rings.run(map).await.ok_or(ExchangeError::Fault)??;
    let socket = RingSocket { producer: watch(Out(producer))?, wanted: 0, written: 0 };
    let consumer = watch(In(consumer))?;
    let frames = RingFrames::new(payload_max);
    let reader = RingReader { consumer, frames, looks: 0, bytes: 0, waits: 0, idle: 0, has_hung_up: false };
    Ok((ClientSocket::Ring(socket), ClientReader::Ring(reader)))
}

/// Resolves when the client has sent something, or has closed. Takes nothing of it: what is beside it is for another thread to close.
async fn something_is_there(stream: &UnixStream) -> Result<(), ExchangeError> {
    loop {
        stream.readable().await.map_err(PassError::System)?;
        match stream.try_io(Interest::READABLE, || reader::look(stream, &mut [0])) {
            Ok(_) => return Ok(()),
            Err(cause) if cause.kind() == io::ErrorKind::WouldBlock => {}
            Err(cause) => return Err(PassError::System(cause).into()),
        }
    }
}

/// Has the reactor of the calling thread listen to a bell.
fn watch<B: AsRawFd>(bell: B) -> Result<AsyncFd<B>, ExchangeError> {
    #[expect(
        deprecated,
        reason = "sound for the two types below, whose bell keeps its descriptor; its successor is an unsafe fn, and unsafe code lives in sinew-shm and the C binding alone"
    )]
    let watched = AsyncFd::with_interest(bell, Interest::READABLE);
    watched.map_err(|cause| PassError::System(cause).into())
}

/// The writing half.
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

/// A producer whose bell for room the reactor watches.
struct Out(Kept<Producer>);

impl AsRawFd for Out {
    fn as_raw_fd(&self) -> RawFd {
        self.0.fd().expect("a socket bell has a descriptor").as_raw_fd()
    }
}

/// A consumer whose bell for messages the reactor watches.
struct In(Kept<Consumer>);

impl AsRawFd for In {
    fn as_raw_fd(&self) -> RawFd {
        self.0.fd().expect("a socket bell has a descriptor").as_raw_fd()
    }
}

/// The ring to a client. Who writes has the outlet's lock; nobody ever waits here.
pub(super) struct RingSocket {
    producer: AsyncFd<Out>,
    /// The record for which there was no room.
    wanted: usize,
    /// Bytes of the ring that were ever used.
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
        // Nothing is known of what a peer that writes nonsense has read.
        let undelivered = self.producer.get_mut().0.untaken().unwrap_or(0);
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
        // A client that sleeps sees then that its socket has hung up.
        self.producer.get_ref().0.ring();
    }
}

fn corrupt(error: LoanError) -> io::Error {
    io::Error::new(io::ErrorKind::InvalidData, format!("shared memory holds what it cannot: {error}"))
}

/// The reading half.
pub(super) enum ClientReader {
    Plain(Reader),
    Ring(RingReader),
}

impl ClientReader {
    /// What comes next. May be dropped at any time without losing a byte.
    pub(super) async fn hear(&mut self, stream: &UnixStream) -> Result<Heard, LinkError> {
        match self {
            Self::Plain(reader) => Ok(reader.hear(stream).await?),
            Self::Ring(reader) => reader.hear(stream).await,
        }
    }

    /// Bytes' worth of work since the last call that no frame came of.
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
    /// Frames and looks since others had their turn.
    looks: usize,
    /// Bytes that these looks took.
    bytes: usize,
    /// Waits since the last frame, or the last turn: a bell can be rung for nothing.
    waits: usize,
    /// Bytes' worth of work that these were.
    idle: usize,
    /// Its process is gone; what it said before still counts.
    has_hung_up: bool,
}

impl RingReader {
    async fn hear(&mut self, stream: &UnixStream) -> Result<Heard, LinkError> {
        loop {
            // Before a frame is taken. spec: LNCL-16
            self.looks += 1;
            if self.looks > LOOKS_A_TURN || self.bytes >= BYTES_A_TURN || self.waits > WAITS_A_TURN {
                (self.looks, self.bytes, self.waits) = (0, 0, 0);
                return Ok(Heard::Turn);
            }
            if let Some(message) = self.frames.next()? {
                self.waits = 0;
                return Ok(Heard::Frame(message));
            }
            let consumer = &mut self.consumer.get_mut().0;
            let taken = self.frames.take(consumer, ENOUGH).map_err(RingError::from)?;
            self.bytes += self.frames.copied();
            match taken {
                Taken::Some => {}
                Taken::Nothing if self.has_hung_up => return Ok(Heard::End),
                Taken::Nothing => self.wait(stream).await?,
            }
        }
    }

    /// Waits until there may be something in the ring, or the peer is gone.
    async fn wait(&mut self, stream: &UnixStream) -> Result<(), LinkError> {
        if self.consumer.get_mut().0.arm().map_err(RingError::from)? == Armed::Ready {
            // Nobody has waited: who publishes one record at a time, each just now, has no more turns by that.
            return Ok(());
        }
        (self.looks, self.bytes) = (0, 0);
        (self.waits, self.idle) = (self.waits + 1, self.idle.saturating_add(READ_WORK));
        tokio::select! {
            biased;
            rung = self.consumer.readable_mut() => match rung {
                // The bell goes with its process, like the socket.
                Ok(rung) if rung.ready().is_read_closed() => self.has_hung_up = true,
                Ok(mut rung) => rung.clear_ready(),
                Err(_) => self.has_hung_up = true,
            },
            heard = hear(stream) => {
                heard?;
                self.has_hung_up = true;
            }
        }
        self.consumer.get_mut().0.disarm();
        Ok(())
    }
}

/// Resolves when the peer has closed the socket, or its process has ended.
async fn hear(stream: &UnixStream) -> Result<(), LinkError> {
    loop {
        if stream.readable().await.is_err() {
            return Ok(());
        }
        // What has come is not taken: a descriptor may be beside it, and goes with the socket.
        match stream.try_io(Interest::READABLE, || reader::look(stream, &mut [0])) {
            Ok(Seen { count: 0, .. }) => return Ok(()),
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
        lingering::{self, Lingering},
        lncl::testing::WATCHDOG,
    };

    /// The node's half, for a client at the other end of the socket that is returned. Its bells take descriptors, as all do before Linux 6.16.
    async fn half_for(rings: &Rings) -> (Half, Arc<UnixStream>, Plain) {
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
    fn a_client_whose_offer_is_refused_after_it_has_passed_what_does_not_close_in_a_bell_costs_nobody_else_his_rings()
     {
        let (say, said) = sync_channel(1);
        let (mut first, mut second) = (Lingering::new(), Lingering::new());
        let passed =
            [&mut first, &mut second].map(|lingering| lingering.ours.take().expect("it is passed once"));
        thread::spawn(move || {
            let runtime = tokio::runtime::Builder::new_current_thread().enable_all().build().unwrap();
            runtime.block_on(async {
                // Given: a client that takes the node's offer, and passes something in each of its bells.
                let rings = Rings::begin(1);
                let (mine, stream, client) = half_for(&rings).await;
                let client = thread::spawn(move || {
                    let theirs = Offer::receive(&client).unwrap().unwrap();
                    for (bell, passed) in theirs.descriptors()[1..].iter().zip(passed) {
                        lingering::pass(bell, b"1", &passed).unwrap();
                    }
                    // When: what it offers is the node's own memory, with what are no bells.
                    let memory = theirs.descriptors()[0].try_clone().unwrap();
                    let others = [(); 2].map(|()| theirs.descriptors()[0].try_clone().unwrap());
                    let offer = [memory].into_iter().chain(others).collect();
                    let bytes: [u8; OFFER_BYTES] = theirs.to_bytes();
                    Offer::from_parts(&bytes, offer).unwrap().send(&client).unwrap();
                    client
                });
                let refused = exchange(mine, &stream, 4_096, &rings).await;
                assert!(matches!(refused, Err(ExchangeError::Refused(_))));
                // Then: another one gets rings.
                let next = half_for(&rings).await;
                // The test has ended, where this comes too late.
                let _ = say.send(());
                drop((next, client.join()));
            });
        });
        assert_eq!(said.recv_timeout(WATCHDOG), Ok(()));
        [first, second].into_iter().for_each(Lingering::let_go);
    }
}
