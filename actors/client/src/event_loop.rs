//! NodeAPI for the event loop of another library, such as asyncio: one descriptor, and the time of the next poll.

#[cfg(test)]
pub(crate) mod tests;

use std::{
    future::poll_fn,
    io,
    mem::MaybeUninit,
    os::{
        fd::{AsFd, BorrowedFd, OwnedFd},
        unix::net::UnixStream,
    },
    path::Path,
    pin::{Pin, pin},
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, AtomicU64, Ordering},
    },
    task::{Context, Poll, Wake, Waker},
    time::Duration,
};

use rustix::{
    event::{EventfdFlags, PollFd, PollFlags, Timespec, epoll, eventfd, poll},
    io::Errno,
};
use sinew_runtime::{lock, time::Time};
use sinew_shm::{Armed, BellKind};

use super::{
    ApiError, AsyncEndpoint, Endpoint, Registration,
    direct::{Direct, Room},
    link::{Link, Reader, RegistrationHandshake, Writer, ring::Rest, socket::has_hung_up},
    reactor::{Listening, Until},
    routes::LinkNumber,
    wait_mode::WaitMode,
};

/// The sources of events: a bell or a waker, or a socket that may have hung up.
const BELL: u64 = 0;
const SOCKET: u64 = 1;
/// Maximum number of events that one poll takes: those of an endpoint without direct links (two bells, the socket to
/// the node, the waker's), and of some links. Further ones cost one more poll.
const EVENTS_MAX: usize = 16;

/// Runs the futures of one [`AsyncEndpoint`] on an event loop that is not tokio's, without a thread.
///
/// The event loop watches one descriptor, this value's [`AsFd`]. It calls [`poll`](Self::poll) for a future first at
/// once, then when the descriptor is readable, and at the latest after [`wake_in`](Self::wake_in). One future at a
/// time; dropping it is safe, as with each future of an [`AsyncEndpoint`].
///
/// The descriptor is an epoll instance, so the set of watched descriptors may change without the event loop. Clones are
/// the same instance.
///
/// # Examples
///
/// An event loop of one future: it blocks in `poll(2)`.
///
/// ```
/// use std::{pin::pin, task::Poll};
///
/// use rustix::event::{PollFd, PollFlags, Timespec, poll};
/// use sinew::client::EventLoop;
///
/// fn run<T>(events: &EventLoop, future: impl Future<Output = T>) -> std::io::Result<T> {
///     let mut future = pin!(future);
///     loop {
///         if let Poll::Ready(value) = events.poll(future.as_mut()) {
///             return Ok(value);
///         }
///         let left = events.wake_in().and_then(|left| Timespec::try_from(left).ok());
///         poll(&mut [PollFd::new(events, PollFlags::IN)], left.as_ref())?;
///     }
/// }
/// # let events = EventLoop::new()?;
/// # assert_eq!(run(&events, std::future::ready(7))?, 7);
/// # Ok::<(), std::io::Error>(())
/// ```
#[derive(Clone, Debug)]
pub struct EventLoop(Arc<Shared>);

#[derive(Debug)]
struct Shared {
    epoll: OwnedFd,
    /// Written by a waker, from any thread. Never read: each write is an event of its own.
    woken: OwnedFd,
    /// The latest time of the next poll, in nanoseconds.
    wake_at: AtomicU64,
    /// Whether an event on a socket was taken that no wait has looked at.
    has_socket_event: AtomicBool,
    /// The direct links with watched descriptors.
    links: Mutex<Vec<LinkNumber>>,
}

impl Wake for Shared {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        // It has room: the counter would be full after 2^64 wakes.
        let _ = rustix::io::write(&self.woken, &1_u64.to_ne_bytes());
    }
}

impl AsFd for EventLoop {
    fn as_fd(&self) -> BorrowedFd<'_> {
        self.0.epoll.as_fd()
    }
}

impl EventLoop {
    /// Creates the descriptor.
    ///
    /// # Errors
    /// The process or the system has no more descriptors.
    pub fn new() -> io::Result<Self> {
        let epoll = epoll::create(epoll::CreateFlags::CLOEXEC)?;
        let woken = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?;
        let wake_at = AtomicU64::new(Time::MAX.as_nanos());
        let events = Self(Arc::new(Shared {
            epoll,
            woken,
            wake_at,
            links: Mutex::default(),
            has_socket_event: AtomicBool::new(false),
        }));
        events.watch(events.0.woken.as_fd(), epoll::EventFlags::IN, BELL)?;
        Ok(events)
    }

    /// Polls a future of the endpoint. If it is not ready, poll it again when the descriptor is readable, and at the
    /// latest after [`wake_in`](Self::wake_in).
    pub fn poll<F: Future + ?Sized>(&self, future: Pin<&mut F>) -> Poll<F::Output> {
        // Takes the events, so that the descriptor is readable again only after a new one. An error leaves it readable,
        // which costs a needless poll.
        let _ = self.take_events(Duration::ZERO);
        self.poll_first(future)
    }

    /// Polls a future of the endpoint for the first time, without the system call that takes the events before it. If
    /// the future is not ready, an event from before causes one needless poll.
    pub fn poll_first<F: Future + ?Sized>(&self, future: Pin<&mut F>) -> Poll<F::Output> {
        self.0.wake_at.store(Time::MAX.as_nanos(), Ordering::Relaxed);
        let waker = Waker::from(Arc::clone(&self.0));
        future.poll(&mut Context::from_waker(&waker))
    }

    /// Blocks until the descriptor is readable, for this time at most, and takes the events. Then the thread calls
    /// [`poll_first`](Self::poll_first). Returns early after a signal.
    ///
    /// # Errors
    /// The descriptor is none any more.
    pub fn take_events(&self, within: Duration) -> io::Result<()> {
        // A longer time than a timespec has is as good as any.
        let left = Timespec::try_from(within).ok();
        match epoll::wait(&self.0.epoll, &mut [MaybeUninit::uninit(); EVENTS_MAX], left.as_ref()) {
            Ok((events, _)) => {
                if events.iter().any(|event| event.data.u64() == SOCKET) {
                    self.0.has_socket_event.store(true, Ordering::Relaxed);
                }
                Ok(())
            }
            Err(Errno::INTR) => Ok(()),
            Err(why) => Err(why.into()),
        }
    }

    /// Returns the time until the next poll of the last future, even if the descriptor is not readable by then; `None`:
    /// no such time.
    #[must_use]
    pub fn wake_in(&self) -> Option<Duration> {
        let at = Time::from_nanos(self.0.wake_at.load(Ordering::Relaxed));
        (at != Time::MAX).then(|| at.since(Time::now()))
    }

    /// Reports each event on a descriptor once. A descriptor that is closed leaves the set.
    fn watch(&self, fd: BorrowedFd<'_>, events: epoll::EventFlags, source: u64) -> io::Result<()> {
        let data = epoll::EventData::new_u64(source);
        match epoll::add(&self.0.epoll, fd, data, events | epoll::EventFlags::ET) {
            // The socket of a registration is that of its link.
            Ok(()) | Err(Errno::EXIST) => Ok(()),
            Err(why) => Err(why.into()),
        }
    }

    /// Watches exactly the open direct links, and the room signal that is waited for.
    fn follow(&self, direct: &mut Direct, room: Option<Room>) {
        let mut links = lock(&self.0.links);
        links.retain(|number| direct.open.iter().any(|link| link.number == *number));
        for link in &direct.open {
            if !links.contains(&link.number) {
                // A link that cannot be watched is polled each `CHECK_INTERVAL`, as all are.
                let _ = link.bell().map(|bell| self.watch(bell, epoll::EventFlags::IN, BELL));
                let _ = self.watch_socket(link.socket());
                links.push(link.number);
            }
        }
        if let Some(Room { link, .. }) = room {
            direct
                .with_room_bell(link, |bell| bell.map(|bell| self.watch(bell, epoll::EventFlags::IN, BELL)));
        }
    }

    /// Watches the descriptors of a link to a node.
    pub(super) fn watch_link(&self, reader: &Reader, writer: &Writer) -> io::Result<()> {
        // An address that has changed has other links.
        lock(&self.0.links).clear();
        let no_bell = || io::Error::from(io::ErrorKind::Unsupported);
        match (reader, writer) {
            (Reader::Ring(reader), Writer::Ring(writer)) => {
                self.watch(reader.bell().ok_or_else(no_bell)?, epoll::EventFlags::IN, BELL)?;
                writer
                    .with_bell(|bell| self.watch(bell.ok_or_else(no_bell)?, epoll::EventFlags::IN, BELL))?;
                self.watch_socket(&reader.socket())
            }
            (Reader::Socket(reader), _) => self.watch(reader.fd(), both_ways(), SOCKET),
            (Reader::Ring(_), Writer::Socket(_)) => unreachable!("both are of one link"),
        }
    }

    fn watch_socket(&self, socket: &UnixStream) -> io::Result<()> {
        self.watch(socket.as_fd(), both_ways(), SOCKET)
    }

    /// Waits until something may have arrived or is to be done, or the requested room, until the deadline at most. May
    /// end early.
    pub(super) async fn wait(
        &self,
        reader: &mut Reader,
        writer: &Writer,
        direct: &mut Direct,
        Until { deadline, room }: Until,
    ) {
        match reader {
            Reader::Socket(socket) => {
                if !is_ready(socket.fd(), PollFlags::IN) {
                    self.sleep(writer, deadline).await;
                }
            }
            Reader::Ring(reader) => {
                self.follow(direct, room);
                let socket = reader.socket();
                let Some(mut listening) = Listening::begin(Some(reader), direct, room) else { return };
                // An event on the socket of the node, or of a link, that a poll has taken without a look at the socket.
                if self.0.has_socket_event.swap(false, Ordering::Relaxed) {
                    if has_hung_up(&socket) {
                        listening.check_at_once();
                    }
                    drop(listening);
                    return direct.on_wake(true);
                }
                self.sleep(writer, deadline).await;
            }
        }
    }

    /// The same while there is no node: for direct links alone.
    pub(super) async fn wait_for_links(&self, direct: &mut Direct, Until { deadline, room }: Until) {
        self.follow(direct, room);
        let Some(_listening) = Listening::begin(None, direct, room) else { return };
        self.until_polled(deadline, |_| Poll::Pending).await;
    }

    /// Waits for room on a direct link alone: no further incoming messages can be read.
    pub(super) async fn wait_for_room(&self, direct: &mut Direct, room: Room, deadline: Time) {
        self.follow(direct, Some(room));
        if direct.arm_room(room) == Armed::Ready {
            return;
        }
        // Not disarmed if this is dropped: the peer may cause one needless wake.
        self.until_polled(deadline, |_| Poll::Pending).await;
        direct.disarm_room(room);
    }

    /// Waits until there may be room for a frame of `length` bytes, or for the rest of one, until `deadline` at most.
    pub(super) async fn room(&self, writer: &Writer, rest: &mut Option<Rest>, length: usize, deadline: Time) {
        let has_room = match (writer, &mut *rest) {
            (Writer::Socket(socket), _) => is_ready(socket.fd(), PollFlags::OUT),
            (Writer::Ring(_), Some(rest)) => rest.arm() == Armed::Ready,
            (Writer::Ring(_), None) => writer.arm(length) == Armed::Ready,
        };
        if !has_room {
            self.sleep(writer, deadline).await;
        }
        match rest {
            Some(rest) => rest.disarm(),
            None => writer.disarm(),
        }
    }

    /// Sleeps until any event, or until `deadline`.
    async fn sleep(&self, writer: &Writer, deadline: Time) {
        let mut pending_added = pin!(writer.pending_added());
        self.until_polled(deadline, |cx| pending_added.as_mut().poll(cx)).await;
    }

    /// Sleeps until `deadline`.
    pub(super) async fn sleep_until(&self, deadline: Time) {
        while Time::now() < deadline {
            self.until_polled(deadline, |_| Poll::Pending).await;
        }
    }

    /// Sleeps until the next poll, or until `event` is ready.
    pub(super) async fn until_polled(
        &self,
        deadline: Time,
        mut event: impl FnMut(&mut Context<'_>) -> Poll<()>,
    ) {
        let mut has_slept = false;
        poll_fn(|cx| {
            // Polled in any case, as it leaves the waker there.
            if event(cx).is_ready() || std::mem::replace(&mut has_slept, true) {
                return Poll::Ready(());
            }
            self.0.wake_at.fetch_min(deadline.as_nanos(), Ordering::Relaxed);
            Poll::Pending
        })
        .await;
    }
}

fn both_ways() -> epoll::EventFlags {
    epoll::EventFlags::IN | epoll::EventFlags::OUT | epoll::EventFlags::RDHUP
}

/// Returns whether a descriptor is ready now. An error is an end, which a read or a write reports.
fn is_ready(fd: BorrowedFd<'_>, what: PollFlags) -> bool {
    let at_once = Timespec { tv_sec: 0, tv_nsec: 0 };
    poll(&mut [PollFd::from_borrowed_fd(fd, what)], Some(&at_once)) != Ok(0)
}

impl Registration {
    /// Registers without blocking, except for the connection to the socket.
    async fn register_on(&self, path: &Path, events: &EventLoop) -> Result<Link, ApiError> {
        let begin = |until| RegistrationHandshake::begin(path, &self.register, self.link.clone(), until);
        let deadline = Time::now() + self.deadline;
        let mut handshake = begin(deadline)?;
        loop {
            events.watch_socket(handshake.socket()).map_err(|why| ApiError::Closed(why.to_string()))?;
            match handshake.wait(Time::now()) {
                Ok(Some(link)) => return Ok(link),
                Ok(None) if Time::now() >= deadline => return Err(self.late(handshake)),
                // Each event on the socket is reported, also one since that look.
                Ok(None) => events.until_polled(deadline, |_| Poll::Pending).await,
                // The node had waited its 2 s for this side, so the retry is paced.
                Err(_) if handshake.may_restart() && Time::now() < deadline => handshake = begin(deadline)?,
                Err(why) => return Err(why),
            }
        }
    }
}

impl AsyncEndpoint {
    /// Registers on the event loop of another library.
    pub(super) async fn register_on(
        path: &Path,
        mut registration: Registration,
        events: EventLoop,
    ) -> Result<Self, ApiError> {
        registration.link.bell = BellKind::Socket.into();
        let link = registration.register_on(path, &events).await?;
        let watched = events.watch_link(&link.reader, &link.writer);
        watched.map_err(|why| ApiError::Closed(why.to_string()))?;
        Ok(Self { endpoint: Endpoint::new(path, registration, link, WaitMode::Polled(events)) })
    }
}
