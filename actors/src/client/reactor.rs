//! The waits of a task: what a blocking thread does with futexes and `poll`, done by the runtime's reactor.
//!
//! The bells of the ring, or the socket, are watched through descriptors of their own, so that an end of the link takes
//! nothing away under the reactor. One wake of the task's thread for each wait that was in earnest, as a thread has.

mod links;

use std::{
    future::poll_fn,
    io,
    os::{
        fd::{AsFd, BorrowedFd},
        unix::net,
    },
    sync::Arc,
};

use rustix::event::{PollFd, PollFlags, Timespec, poll};
use sinew_runtime::time::Time;
use sinew_shm::{Armed, Looked, Looking};
use tokio::{
    io::Interest,
    net::UnixStream,
    sync::oneshot,
    task::{spawn_blocking, yield_now},
};

use links::{Heard, Links, forget};

use super::{
    direct::{Direct, Everything, Room, Standing},
    link::{
        Link, Reader, Writer,
        ring::{self, NAP, Rest},
    },
    returning::{Home, come_home},
};

/// What is watched for a task.
pub(super) struct Reactor {
    ears: Ears,
    links: Links,
    /// The way back, while it is looked for.
    home: Option<oneshot::Receiver<Link>>,
    /// Who looks for it stops when this is gone.
    wanted: Arc<()>,
}

enum Ears {
    Socket(UnixStream),
    Ring {
        message: UnixStream,
        room: UnixStream,
        /// Hangs up with the node.
        socket: UnixStream,
    },
}

/// What a wait ends with, if nothing comes before.
#[derive(Clone, Copy, Debug)]
pub(super) struct Until {
    pub(super) deadline: Time,
    /// Room on a direct link, or what may be room.
    pub(super) room: Option<Room>,
}

impl Reactor {
    /// Watches a link, for the runtime of the calling task.
    pub(super) fn new(reader: &Reader, writer: &Writer) -> io::Result<Self> {
        let (ears, links) = (Ears::of(reader, writer)?, Links::default());
        Ok(Self { ears, links, home: None, wanted: Arc::new(()) })
    }

    /// Waits until there may be something to read, or to do, or the room that is asked for, until `deadline` at most.
    pub(super) async fn wait(
        &mut self,
        reader: &mut Reader,
        writer: &Writer,
        direct: &mut Direct,
        until: Until,
    ) {
        match (&self.ears, reader) {
            (Ears::Socket(socket), _) => tokio::select! {
                () = ready(socket, Interest::READABLE, PollFlags::IN) => {}
                () = writer.owing() => {}
                () = at(until.deadline) => {}
            },
            (Ears::Ring { .. }, Reader::Ring(reader)) => {
                // Looking sees no room.
                let looking = until.room.is_none().then(|| reader.begin_looking()).flatten();
                let has_come = match &looking {
                    Some(looking) => finds_something(looking, until.deadline, reader, &mut direct.open).await,
                    None => false,
                };
                if !has_come {
                    self.sleep(reader, writer, direct, until).await;
                }
                if let Some(looking) = looking {
                    reader.end_looking(&looking);
                }
            }
            (Ears::Ring { .. }, Reader::Socket(_)) => unreachable!("both are of one link"),
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
        let Ears::Ring { message, socket, .. } = &self.ears else { return };
        self.links.follow(direct, room);
        let Some(mut listening) = Listening::begin(Some(reader), direct, room) else { return };
        let links = &mut self.links;
        let heard = tokio::select! {
            () = rung(message) => Heard::Bell,
            () = ready(socket, Interest::READABLE, PollFlags::RDHUP) => {
                listening.look_at_once();
                Heard::Bell
            }
            heard = poll_fn(|cx| links.poll(cx)) => heard,
            () = writer.owing() => Heard::Bell,
            () = at(deadline) => Heard::Bell,
        };
        drop(listening);
        direct.heard(heard == Heard::HungUp);
    }

    /// The same while there is no node: for direct links alone.
    pub(super) async fn wait_for_links(&mut self, direct: &mut Direct, Until { deadline, room }: Until) {
        self.links.follow(direct, room);
        let Some(listening) = Listening::begin(None, direct, room) else { return };
        let links = &mut self.links;
        let heard = tokio::select! {
            heard = poll_fn(|cx| links.poll(cx)) => heard,
            () = at(deadline) => Heard::Bell,
        };
        drop(listening);
        direct.heard(heard == Heard::HungUp);
    }

    /// Waits for room on a direct link alone: of what others send nothing more can be taken in.
    pub(super) async fn wait_for_room(&mut self, direct: &mut Direct, room: Room, deadline: Time) {
        self.links.follow(direct, Some(room));
        if direct.arm_room(room) == Armed::Ready {
            return;
        }
        let links = &mut self.links;
        // Not disarmed if this is dropped: the peer may ring once for nothing.
        tokio::select! {
            () = poll_fn(|cx| links.poll_room(cx)) => {}
            () = at(deadline) => {}
        }
        direct.disarm_room(room);
    }

    /// Waits until there may be room for a frame of `length` bytes, or for the rest of one, until `deadline` at most.
    pub(super) async fn room(&self, writer: &Writer, rest: &mut Option<Rest>, length: usize, deadline: Time) {
        match &self.ears {
            Ears::Socket(socket) => tokio::select! {
                () = ready(socket, Interest::WRITABLE, PollFlags::OUT) => {}
                () = at(deadline) => {}
            },
            Ears::Ring { room, socket, .. } => {
                let armed = match rest {
                    Some(rest) => rest.arm(),
                    None => writer.arm(length),
                };
                if armed == Armed::Ready {
                    return;
                }
                // Not disarmed if this is dropped: the node may ring once for nothing.
                tokio::select! {
                    () = rung(room) => {}
                    () = ready(socket, Interest::READABLE, PollFlags::RDHUP) => {}
                    () = at(deadline) => {}
                }
                match rest {
                    Some(rest) => rest.disarm(),
                    None => writer.disarm(),
                }
            }
        }
    }

    /// Looks for the way back, on a thread of the runtime's pool that may block; what it has found, once it has.
    pub(super) fn look_home(&mut self, home: &Home) -> Option<Link> {
        let found = self.home.get_or_insert_with(|| {
            let (found, hear) = oneshot::channel();
            let (home, wanted) = (home.another(), Arc::downgrade(&self.wanted));
            spawn_blocking(move || {
                if let Some(link) = come_home(home, || wanted.strong_count() > 0) {
                    // Not wanted any more: dropped, it is given back.
                    let _ = found.send(link);
                }
            });
            hear
        });
        let link = found.try_recv();
        if !matches!(link, Err(oneshot::error::TryRecvError::Empty)) {
            self.home = None;
        }
        link.ok()
    }

    /// Waits until the way back is found, until something comes on a direct link, until `deadline` at most.
    pub(super) async fn await_home(
        &mut self,
        home: &Home,
        direct: &mut Direct,
        deadline: Time,
    ) -> Option<Link> {
        if let Some(link) = self.look_home(home) {
            return Some(link);
        }
        if !direct.open.is_empty() {
            let now = Time::now();
            let deadline = direct.wake_by(deadline.min(now + NAP), now, None);
            self.wait_for_links(direct, Until { deadline, room: None }).await;
            return self.look_home(home);
        }
        let found = self.home.as_mut()?;
        let link = tokio::select! {
            link = found => link.ok(),
            () = at(deadline) => return None,
        };
        self.home = None;
        link
    }

    /// Watches another link.
    pub(super) fn change(&mut self, reader: &Reader, writer: &Writer) -> io::Result<()> {
        self.ears = Ears::of(reader, writer)?;
        Ok(())
    }
}

impl Ears {
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

/// Looks as long as it is to before a sleep, and not beyond `deadline`; whether something has come. Other tasks have their turn between.
async fn finds_something(
    looking: &Looking,
    deadline: Time,
    reader: &mut ring::Reader,
    links: &mut [Standing],
) -> bool {
    loop {
        match reader.look(looking, |node| Everything { node, links }) {
            Looked::Something => return true,
            Looked::Nothing => return false,
            Looked::NotYet if Time::now() >= deadline => return false,
            Looked::NotYet => yield_now().await,
        }
    }
}

/// Who has announced that he sleeps: the readers, and the sender that waits for room. Awake again when dropped.
struct Listening<'a> {
    node: Option<&'a mut ring::Reader>,
    direct: &'a mut Direct,
    room: Option<Room>,
}

impl<'a> Listening<'a> {
    /// `None` if there is something to do already.
    fn begin(node: Option<&'a mut ring::Reader>, direct: &'a mut Direct, room: Option<Room>) -> Option<Self> {
        let mut listening = Self { node, direct, room };
        let Self { node, direct, room } = &mut listening;
        let is_silent = node.as_mut().is_none_or(|node| node.arm() == Armed::Sleep)
            && direct.open.iter_mut().all(|link| link.arm() == Armed::Sleep)
            && room.is_none_or(|room| direct.arm_room(room) == Armed::Sleep);
        is_silent.then_some(listening)
    }

    /// The node's socket is to be looked at.
    fn look_at_once(&mut self) {
        if let Some(node) = &mut self.node {
            node.look_at_once();
        }
    }
}

impl Drop for Listening<'_> {
    fn drop(&mut self) {
        if let Some(node) = &mut self.node {
            node.disarm();
        }
        self.direct.open.iter_mut().for_each(Standing::disarm);
        if let Some(room) = self.room {
            self.direct.disarm_room(room);
        }
    }
}

/// Has the reactor watch what is behind a descriptor.
fn watch(fd: BorrowedFd<'_>) -> io::Result<UnixStream> {
    let socket = net::UnixStream::from(fd.try_clone_to_owned()?);
    // The reactor asks for it; here nothing waits at a descriptor in any case.
    socket.set_nonblocking(true)?;
    UnixStream::from_std(socket)
}

/// Ends when a bell rings. What it was rung for is looked at after this, so that no ring is lost.
async fn rung(bell: &UnixStream) {
    // An error is an end, which shows elsewhere.
    if bell.readable().await.is_ok() {
        forget(bell);
    }
}

/// Ends when the system says so of the socket now, whatever was read from it or written to it meanwhile.
async fn ready(socket: &UnixStream, interest: Interest, what: PollFlags) {
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

/// Ends at `deadline`.
async fn at(deadline: Time) {
    if deadline == Time::MAX {
        return std::future::pending().await;
    }
    tokio::time::sleep(deadline.since(Time::now())).await;
}
