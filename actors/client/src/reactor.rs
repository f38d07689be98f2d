//! The waits of a task: the runtime's reactor replaces the futexes and `poll` of a blocking thread.
//!
//! The wake-up sockets of the ring, or the socket, are watched through duplicate descriptors. So the end of a
//! link does not remove a descriptor that the reactor uses. Each wait that sleeps costs one wake of the
//! task's thread, as for a thread.

mod links;

use std::{
    future::poll_fn,
    io,
    os::{
        fd::{AsFd, BorrowedFd},
        unix::net,
    },
    pin::{Pin, pin},
    sync::Arc,
    task::{Context, Poll, ready},
};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use sinew_runtime::time::Time;
use sinew_shm::{Armed, PollResult, Polling};
use tokio::{
    io::Interest,
    net::UnixStream,
    sync::oneshot,
    task::{spawn_blocking, yield_now},
    time::{Instant, Sleep, sleep_until},
};

use links::{LinkEvent, Links, forget};

use super::{
    direct::{AllEnds, Direct, EstablishedLink, Room},
    link::{
        Link, Reader, Writer,
        ring::{self, CHECK_INTERVAL, Rest},
        socket as link_socket,
    },
    reconnect::{Reconnect, reconnect_blocking},
};

/// The descriptors that are watched for a task.
pub(super) struct Reactor {
    watches: Watches,
    links: Links,
    timer: Timer,
    /// The reconnection in progress.
    reconnect: Option<oneshot::Receiver<Link>>,
    /// The reconnecting thread stops when this is dropped.
    wanted: Arc<()>,
}

enum Watches {
    Socket(UnixStream),
    Ring {
        message: UnixStream,
        room: UnixStream,
        /// Closes when the node closes it.
        socket: UnixStream,
    },
}

/// The conditions that end a wait.
#[derive(Clone, Copy, Debug)]
pub(super) struct Until {
    pub(super) deadline: Time,
    /// Room, or possible room, on a direct link.
    pub(super) room: Option<Room>,
}

impl Reactor {
    /// Watches a link, for the runtime of the calling task.
    pub(super) fn new(reader: &Reader, writer: &Writer) -> io::Result<Self> {
        let (watches, links) = (Watches::of(reader, writer)?, Links::default());
        let (timer, wanted) = (Timer::default(), Arc::new(()));
        Ok(Self { watches, links, timer, reconnect: None, wanted })
    }

    /// Waits until there may be something to read or to do, or the requested room, until `deadline` at most.
    pub(super) async fn wait(
        &mut self,
        reader: &mut Reader,
        writer: &Writer,
        direct: &mut Direct,
        until: Until,
    ) {
        match (&self.watches, reader) {
            (Watches::Socket(socket), _) => tokio::select! {
                () = is_ready(socket, Interest::READABLE, PollFlags::IN) => {}
                () = writer.pending_added() => {}
                () = at(until.deadline) => {}
            },
            (Watches::Ring { .. }, Reader::Ring(reader)) => {
                // Spinning does not detect room.
                let looking = until.room.is_none().then(|| reader.begin_spin()).flatten();
                let has_arrived = match &looking {
                    Some(looking) => {
                        spin_until_arrival(looking, until.deadline, reader, &mut direct.open).await
                    }
                    None => false,
                };
                if !has_arrived {
                    self.sleep(reader, writer, direct, until).await;
                }
                if let Some(looking) = looking {
                    reader.end_spin(&looking);
                }
            }
            (Watches::Ring { .. }, Reader::Socket(_)) => unreachable!("both are of one link"),
        }
    }

    /// Sleeps at the node's ring and the links, once.
    async fn sleep(
        &mut self,
        reader: &mut ring::Reader,
        writer: &Writer,
        direct: &mut Direct,
        Until { deadline, room }: Until,
    ) {
        let Watches::Ring { message, socket, .. } = &self.watches else { return };
        self.links.follow(direct, room);
        let Some(mut listening) = Listening::begin(Some(reader), direct, room) else { return };
        let (links, timer) = (&mut self.links, &mut self.timer);
        timer.end_by(deadline);
        // One future. Only its last part has a list of waiters: a wait for each part in a `select` costs as much as the
        // message.
        let mut pending_added = pin!(writer.pending_added());
        let event = poll_fn(|cx| {
            // First: a node that has gone has closed its bell, too, which is always ready then.
            if poll_hung_up(socket, cx).is_ready() {
                listening.check_at_once();
                return Poll::Ready(LinkEvent::Bell);
            }
            if poll_rung(message, cx).is_ready() {
                return Poll::Ready(LinkEvent::Bell);
            }
            match links.poll(cx) {
                Poll::Pending if pending_added.as_mut().poll(cx).is_ready() || timer.poll(cx).is_ready() => {
                    Poll::Ready(LinkEvent::Bell)
                }
                event @ (Poll::Ready(_) | Poll::Pending) => event,
            }
        })
        .await;
        drop(listening);
        direct.on_wake(event == LinkEvent::HungUp);
    }

    /// The same while there is no node: for direct links alone.
    pub(super) async fn wait_for_links(&mut self, direct: &mut Direct, Until { deadline, room }: Until) {
        self.links.follow(direct, room);
        let Some(listening) = Listening::begin(None, direct, room) else { return };
        let links = &mut self.links;
        let event = tokio::select! {
            event = poll_fn(|cx| links.poll(cx)) => event,
            () = at(deadline) => LinkEvent::Bell,
        };
        drop(listening);
        direct.on_wake(event == LinkEvent::HungUp);
    }

    /// Waits for room on a direct link alone: no further incoming messages can be read.
    pub(super) async fn wait_for_room(&mut self, direct: &mut Direct, room: Room, deadline: Time) {
        self.links.follow(direct, Some(room));
        if direct.arm_room(room) == Armed::Ready {
            return;
        }
        let links = &mut self.links;
        // Not disarmed if this is dropped: the peer may cause one needless wake.
        tokio::select! {
            () = poll_fn(|cx| links.poll_room(cx)) => {}
            () = at(deadline) => {}
        }
        direct.disarm_room(room);
    }

    /// Waits until there may be room for a frame of `length` bytes, or for the rest of one, until `deadline`
    /// at most.
    pub(super) async fn room(&self, writer: &Writer, rest: &mut Option<Rest>, length: usize, deadline: Time) {
        match &self.watches {
            Watches::Socket(socket) => tokio::select! {
                () = is_ready(socket, Interest::WRITABLE, PollFlags::OUT) => {}
                () = at(deadline) => {}
            },
            Watches::Ring { room, socket, .. } => {
                let armed = match rest {
                    Some(rest) => rest.arm(),
                    None => writer.arm(length),
                };
                if armed == Armed::Ready {
                    return;
                }
                // Not disarmed if this is dropped: the node may cause one needless wake.
                tokio::select! {
                    () = rung(room) => {}
                    () = is_ready(socket, Interest::READABLE, PollFlags::RDHUP) => {}
                    () = at(deadline) => {}
                }
                match rest {
                    Some(rest) => rest.disarm(),
                    None => writer.disarm(),
                }
            }
        }
    }

    /// Reconnects on a thread of the runtime's blocking pool. Returns the new link once it is established.
    pub(super) fn poll_reconnect(&mut self, reconnect: &Reconnect) -> Option<Link> {
        let found = self.reconnect.get_or_insert_with(|| {
            let (found, receiver) = oneshot::channel();
            let (reconnect, wanted) = (reconnect.another(), Arc::downgrade(&self.wanted));
            spawn_blocking(move || {
                if let Some(link) = reconnect_blocking(reconnect, || wanted.strong_count() > 0) {
                    // If the link is not wanted any more, dropping it releases the address.
                    let _ = found.send(link);
                }
            });
            receiver
        });
        let link = found.try_recv();
        if !matches!(link, Err(oneshot::error::TryRecvError::Empty)) {
            self.reconnect = None;
        }
        link.ok()
    }

    /// Waits until the reconnection succeeds, until a message arrives on a direct link, or until `deadline`.
    pub(super) async fn await_reconnect(
        &mut self,
        reconnect: &Reconnect,
        direct: &mut Direct,
        deadline: Time,
    ) -> Option<Link> {
        if let Some(link) = self.poll_reconnect(reconnect) {
            return Some(link);
        }
        if !direct.open.is_empty() {
            let now = Time::now();
            let deadline = direct.wake_by(deadline.min(now + CHECK_INTERVAL), now, None);
            self.wait_for_links(direct, Until { deadline, room: None }).await;
            return self.poll_reconnect(reconnect);
        }
        let found = self.reconnect.as_mut()?;
        let link = tokio::select! {
            link = found => link.ok(),
            () = at(deadline) => return None,
        };
        self.reconnect = None;
        link
    }

    /// Watches another link.
    pub(super) fn change(&mut self, reader: &Reader, writer: &Writer) -> io::Result<()> {
        self.watches = Watches::of(reader, writer)?;
        Ok(())
    }
}

impl Watches {
    fn of(reader: &Reader, writer: &Writer) -> io::Result<Self> {
        match (reader, writer) {
            (Reader::Ring(reader), Writer::Ring(writer)) => {
                let no_bell = || io::Error::from(io::ErrorKind::Unsupported);
                let message = watch(reader.bell().ok_or_else(no_bell)?)?;
                let room = writer.with_bell(|bell| watch(bell.ok_or_else(no_bell)?))?;
                Ok(Self::Ring { message, room, socket: watch(reader.socket().as_fd())? })
            }
            (Reader::Socket(reader), _) => Ok(Self::Socket(watch(reader.fd())?)),
            (Reader::Ring(_), Writer::Socket(_)) => unreachable!("both are of one link"),
        }
    }
}

/// Spins before a sleep, for the configured time and at most until `deadline`. Returns whether anything has
/// arrived. Other tasks run in between.
async fn spin_until_arrival(
    looking: &Polling,
    deadline: Time,
    reader: &mut ring::Reader,
    links: &mut [EstablishedLink],
) -> bool {
    loop {
        match reader.look(looking, |node| AllEnds { node, links }) {
            PollResult::Ready => return true,
            PollResult::Idle => return false,
            PollResult::NotYet if Time::now() >= deadline => return false,
            PollResult::NotYet => yield_now().await,
        }
    }
}

/// The announced sleepers: the readers, and the sender that waits for room. Dropping it disarms them.
pub(super) struct Listening<'a> {
    node: Option<&'a mut ring::Reader>,
    direct: &'a mut Direct,
    room: Option<Room>,
}

impl<'a> Listening<'a> {
    /// Announces the sleep. Returns `None` if there is something to do already.
    pub(super) fn begin(
        node: Option<&'a mut ring::Reader>,
        direct: &'a mut Direct,
        room: Option<Room>,
    ) -> Option<Self> {
        let mut listening = Self { node, direct, room };
        let Self { node, direct, room } = &mut listening;
        let is_silent = node.as_mut().is_none_or(|node| node.arm() == Armed::Sleep)
            && direct.open.iter_mut().all(|link| link.arm() == Armed::Sleep)
            && room.is_none_or(|room| direct.arm_room(room) == Armed::Sleep);
        is_silent.then_some(listening)
    }

    /// Makes the next poll check the node's socket.
    pub(super) fn check_at_once(&mut self) {
        if let Some(node) = &mut self.node {
            node.check_at_once();
        }
    }
}

impl Drop for Listening<'_> {
    fn drop(&mut self) {
        if let Some(node) = &mut self.node {
            node.disarm();
        }
        self.direct.open.iter_mut().for_each(EstablishedLink::disarm);
        if let Some(room) = self.room {
            self.direct.disarm_room(room);
        }
    }
}

/// Registers a duplicate of a descriptor with the reactor.
fn watch(fd: BorrowedFd<'_>) -> io::Result<UnixStream> {
    let socket = net::UnixStream::from(fd.try_clone_to_owned()?);
    // The reactor requires it; no code here blocks on a descriptor in any case.
    socket.set_nonblocking(true)?;
    UnixStream::from_std(socket)
}

/// Resolves when a wake-up socket is signalled. The state is checked after this, so that no signal is lost.
async fn rung(bell: &UnixStream) {
    // An error is an end, which is detected elsewhere.
    if bell.readable().await.is_ok() {
        forget(bell);
    }
}

/// The same, as a poll of the endpoint's only task.
fn poll_rung(bell: &UnixStream, cx: &mut Context<'_>) -> Poll<()> {
    // An error is an end, which is detected elsewhere.
    if ready!(bell.poll_read_ready(cx)).is_ok() {
        forget(bell);
    }
    Poll::Ready(())
}

/// Ready when the other end of a socket has closed it.
fn poll_hung_up(socket: &UnixStream, cx: &mut Context<'_>) -> Poll<()> {
    loop {
        // An error is the end of the reactor, and stays.
        if ready!(socket.poll_read_ready(cx)).is_err() || link_socket::hangs_up(socket) {
            return Poll::Ready(());
        }
        forget(socket);
    }
}

/// The timer of a task's waits. Each of them ends long before its deadline, and the next one has a later deadline. So
/// the timer is set again only when it has ended, or for an earlier end: mostly it ends one wait in twenty early.
#[derive(Default)]
struct Timer {
    sleep: Option<Pin<Box<Sleep>>>,
    /// When it ends; `None` if it does not, or has.
    end: Option<Time>,
}

impl Timer {
    /// Ends at `deadline`, or before. Never, if that is never.
    fn end_by(&mut self, deadline: Time) {
        if deadline == Time::MAX {
            self.end = None;
            return;
        }
        if self.end.is_some_and(|end| end <= deadline) {
            return;
        }
        self.end = Some(deadline);
        let at = Instant::now() + deadline.since(Time::now());
        match &mut self.sleep {
            Some(sleep) => sleep.as_mut().reset(at),
            None => self.sleep = Some(Box::pin(sleep_until(at))),
        }
    }

    fn poll(&mut self, cx: &mut Context<'_>) -> Poll<()> {
        let Some(sleep) = self.sleep.as_mut().filter(|_| self.end.is_some()) else { return Poll::Pending };
        ready!(sleep.as_mut().poll(cx));
        self.end = None;
        Poll::Ready(())
    }
}

/// Resolves when the system reports this readiness of the socket now, despite reads or writes in between.
async fn is_ready(socket: &UnixStream, interest: Interest, what: PollFlags) {
    let now = || {
        let nothing = Timespec { tv_sec: 0, tv_nsec: 0 };
        match poll(&mut [PollFd::new(socket, what)], Some(&nothing)) {
            Ok(0) => Err(io::Error::from(io::ErrorKind::WouldBlock)),
            Ok(_) | Err(_) => Ok(()),
        }
    };
    while socket.ready(interest).await.is_ok() {
        if socket.try_io(interest, now).is_ok() {
            return;
        }
    }
}

/// Resolves at `deadline`.
async fn at(deadline: Time) {
    if deadline == Time::MAX {
        return std::future::pending().await;
    }
    tokio::time::sleep(deadline.since(Time::now())).await;
}
