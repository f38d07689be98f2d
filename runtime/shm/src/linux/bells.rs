//! The three bells: a futex, an eventfd, a pair of sockets.

use std::{
    io::{self, IoSliceMut},
    os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd},
    sync::{
        Arc,
        atomic::{AtomicU32, Ordering},
    },
    time::{Duration, Instant},
};

use rustix::{
    event::{EventfdFlags, PollFd, PollFlags, eventfd, poll},
    fs::{Timespec, readlink},
    io::{Errno, ReadWriteFlags, ioctl_fionread, preadv2},
    net::{
        AddressFamily, RecvAncillaryBuffer, RecvFlags, ReturnFlags, SendFlags, Shutdown, SocketFlags,
        SocketType, getpeername, recv, recvmsg, send, shutdown, socketpair, sockopt,
    },
    thread::futex,
};

use super::{
    mapping::Mapping,
    memfd::{adopt_page, create_page},
    rights::{keep_urgent_in_line, set_descriptors},
};
use crate::{
    bell::{Bell, BellKind, Bells, CommonBell, Doorbell, Heard, Woken},
    error::{CreateError, RefusedOffer},
    offer::Descriptors,
    wait::{HangUp, Waiting},
};

/// For messages, and for room.
type Both = (Box<dyn Doorbell>, Box<dyn Doorbell>);

/// A region's bells.
pub(crate) fn bells(bell: &Bell) -> Result<Bells, CreateError> {
    let made = match bell {
        Bell::OfItsOwn(BellKind::Futex) => SharedPage::create().and_then(|page| page.bells()),
        Bell::OfItsOwn(BellKind::EventFd) => pair_of(event),
        Bell::OfItsOwn(BellKind::Socket) => pair_of(socket),
        Bell::Common(CommonBell(page)) => page.bells(),
    };
    made.map_err(|cause| CreateError::System { step: "making bells", cause })
}

/// A page of futexes, for one region or several.
#[derive(Clone, Debug)]
pub(crate) struct SharedPage {
    page: Arc<Mapping>,
    memory: Arc<OwnedFd>,
}

impl SharedPage {
    pub(crate) fn create() -> io::Result<Self> {
        let (page, memory) = create_page()?;
        Ok(Self { page: Arc::new(page), memory: Arc::new(memory) })
    }

    fn bells(&self) -> io::Result<Bells> {
        let (message, room) = on_page(Arc::clone(&self.page));
        Ok(Bells { message, room, buttons: vec![self.memory.try_clone()?] })
    }
}

fn on_page(page: Arc<Mapping>) -> Both {
    let bell = |index| Box::new(FutexBell { page: Arc::clone(&page), index });
    (bell(MESSAGE_WORD), bell(ROOM_WORD))
}

fn pair_of<T: Doorbell + 'static>(make: fn() -> io::Result<(T, OwnedFd)>) -> io::Result<Bells> {
    let ((message, message_button), (room, room_button)) = (make()?, make()?);
    let buttons = vec![message_button, room_button];
    Ok(Bells { message: Box::new(message), room: Box::new(room), buttons })
}

fn event() -> io::Result<(EventBell, OwnedFd)> {
    let ear = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?;
    let button = rustix::io::fcntl_dupfd_cloexec(&ear, 0)?;
    Ok((EventBell(ear), button))
}

fn socket() -> io::Result<(SocketBell, OwnedFd)> {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    let (ear, button) = socketpair(AddressFamily::UNIX, SocketType::STREAM, flags, None)?;
    // Who drains the ear would close them. Where the system does not know it (Linux before 6.16) it is looked at first.
    let looks = set_descriptors(ear.as_fd(), Descriptors::Refused).is_err();
    keep_urgent_in_line(ear.as_fd())?;
    Ok((SocketBell { socket: ear, looks }, button))
}

/// The peer's bells, to be rung by this side, if the descriptors are such.
pub(crate) fn buttons(kind: BellKind, fds: Vec<OwnedFd>) -> Result<Both, RefusedOffer> {
    let mut fds = fds.into_iter();
    match (kind, fds.next(), fds.next()) {
        (BellKind::Futex, Some(fd), None) => {
            let page = adopt_page(&fd)
                .map_err(|cause| RefusedOffer::System { step: "mapping the offered page of bells", cause })?;
            page.map(Arc::new).map(on_page).ok_or(RefusedOffer::NotABell(kind))
        }
        (BellKind::EventFd, Some(message), Some(room)) if is_eventfd(&message)? && is_eventfd(&room)? => {
            Ok((Box::new(EventBell(message)), Box::new(EventBell(room))))
        }
        (BellKind::Socket, Some(message), Some(room)) if is_button(&message) && is_button(&room) => {
            Ok((Box::new(button(message)), Box::new(button(room))))
        }
        (BellKind::Futex | BellKind::EventFd | BellKind::Socket, _, _) => Err(RefusedOffer::NotABell(kind)),
    }
}

/// Whether it is the end of a connection of unix sockets, in which nothing lies: that, descriptors beside it, would be closed with it. Nothing
/// more comes: a button is rung, not read, and no copy of it that the peer has kept takes this back.
fn is_button(fd: &OwnedFd) -> bool {
    // One that has no other end could listen, now or later, and what waits to be accepted would be closed with it.
    let is_end = sockopt::socket_domain(fd) == Ok(AddressFamily::UNIX)
        && sockopt::socket_type(fd) == Ok(SocketType::STREAM)
        && getpeername(fd).is_ok();
    if !is_end {
        return false;
    }
    // It fails where the other end has gone, from which nothing comes either.
    let _ = shutdown(fd, Shutdown::Read);
    // Counted, not looked at: an urgent byte is passed over by a look, and so is what lies before the place from where the peer has it look.
    ioctl_fionread(fd) == Ok(0)
}

fn is_eventfd(fd: &OwnedFd) -> Result<bool, RefusedOffer> {
    let name = readlink(format!("/proc/self/fd/{}", fd.as_raw_fd()), Vec::new());
    let name = name.map_err(|errno| RefusedOffer::System {
        step: "asking what the offered bell is (/proc/self/fd)",
        cause: errno.into(),
    })?;
    Ok(name.as_bytes() == b"anon_inode:[eventfd]")
}

/// How often who sleeps on a futex looks whether the peer is still there: a futex and a descriptor cannot be waited for at
/// once.
const HANG_UP_LOOK: Duration = Duration::from_millis(20);

const MESSAGE_WORD: usize = 0;
const ROOM_WORD: usize = 32;

/// Wakes one who sleeps at a word.
pub(super) fn wake(word: &AtomicU32) {
    // Not private: the sleeper is in another process. It can fail only for a bad address, which this is not.
    let _ = futex::wake(word, futex::Flags::empty(), 1);
}

/// A word that each ring changes, in a page that both sides write.
///
/// Not the tail or head itself: the sleeper's mapping of those is read-only, and a futex on a read-only mapping costs half a
/// microsecond more each time. What a hostile peer writes here ends sleeps early, or lets rings go unheard: its own and, where several regions have
/// the page, those of others until `Waiter` has found that out.
struct FutexBell {
    page: Arc<Mapping>,
    index: usize,
}

impl FutexBell {
    fn counter(&self) -> &AtomicU32 {
        self.page.shared_word(self.index)
    }
}

impl Doorbell for FutexBell {
    fn word(&self) -> Option<&AtomicU32> {
        Some(self.counter())
    }

    fn ring(&self) {
        // SYNC: who hears this ring in `listen` also sees what it was rung for.
        self.counter().fetch_add(1, Ordering::Release);
        wake(self.counter());
    }

    fn listen(&self) -> Heard {
        Heard(self.counter().load(Ordering::Acquire))
    }

    fn sleep(&self, heard: Heard, waiting: &Waiting<'_>) -> io::Result<Woken> {
        let left = waiting.left(Instant::now());
        let now = waiting.hang_up.map_or(left, |_| left.min(HANG_UP_LOOK));
        match futex::wait(self.counter(), futex::Flags::empty(), heard.0, Some(&timespec(now))) {
            // Rung before the sleep; a signal came. The caller looks again.
            Ok(()) | Err(Errno::AGAIN | Errno::INTR) => return Ok(Woken::Rung),
            Err(Errno::TIMEDOUT) => {}
            Err(errno) => return Err(errno.into()),
        }
        if waiting.hang_up.map_or(Ok(false), has_ended)? {
            Ok(Woken::HungUp)
        } else if now == left {
            Ok(Woken::TimedOut)
        } else {
            // The caller looks again: another one who may write the word can have taken the ring, and put the number back.
            Ok(Woken::Rung)
        }
    }

    fn fd(&self) -> Option<BorrowedFd<'_>> {
        None
    }

    fn drain(&self) {
        // A futex keeps nothing.
    }
}

/// A descriptor keeps a ring until it is drained.
const HEARD_IN_THE_DESCRIPTOR: Heard = Heard(0);

struct EventBell(OwnedFd);

impl Doorbell for EventBell {
    fn ring(&self) {
        // Full means that it is rung already.
        let _ = rustix::io::write(&self.0, &1_u64.to_ne_bytes());
    }

    fn listen(&self) -> Heard {
        HEARD_IN_THE_DESCRIPTOR
    }

    fn sleep(&self, _: Heard, waiting: &Waiting<'_>) -> io::Result<Woken> {
        poll_for(self, waiting)
    }

    fn fd(&self) -> Option<BorrowedFd<'_>> {
        Some(self.0.as_fd())
    }

    fn drain(&self) {
        // Not a plain read: the peer may have made the descriptor, which is shared with it, blocking.
        let mut count = [0; 8];
        let at_the_file_position = u64::MAX;
        let _ = preadv2(
            &self.0,
            &mut [IoSliceMut::new(&mut count)],
            at_the_file_position,
            ReadWriteFlags::NOWAIT,
        );
    }
}

struct SocketBell {
    socket: OwnedFd,
    /// Descriptors may come with what is heard.
    looks: bool,
}

/// A bell of the peer's, of which nothing is heard.
const fn button(socket: OwnedFd) -> SocketBell {
    SocketBell { socket, looks: false }
}

impl Doorbell for SocketBell {
    fn ring(&self) {
        // Full means that it is rung already; closed means that nobody waits.
        let _ = send(&self.socket, &[1], SendFlags::DONTWAIT | SendFlags::NOSIGNAL);
    }

    fn listen(&self) -> Heard {
        HEARD_IN_THE_DESCRIPTOR
    }

    fn sleep(&self, _: Heard, waiting: &Waiting<'_>) -> io::Result<Woken> {
        if self.looks && undescribed(&self.socket, &mut [0; RINGS_MAX]).is_none() {
            // It would end every sleep, and can be taken out by nobody who may not wait.
            return Ok(Woken::HungUp);
        }
        poll_for(self, waiting)
    }

    fn fd(&self) -> Option<BorrowedFd<'_>> {
        Some(self.socket.as_fd())
    }

    fn drain(&self) {
        let mut rings = [0; RINGS_MAX];
        let count = if self.looks { undescribed(&self.socket, &mut rings) } else { Some(RINGS_MAX) };
        if let Some(count) = count {
            let _ = recv(&self.socket, &mut rings[..count], RecvFlags::DONTWAIT);
        }
    }
}

/// Bytes that are drained at once. More was rung only by a peer that rings for fun; then the next sleep ends early.
const RINGS_MAX: usize = 64;

/// So many bytes can be taken without a descriptor beside them; `None` if there is one. All stays where it is.
fn undescribed(socket: &OwnedFd, rings: &mut [u8]) -> Option<usize> {
    let flags = RecvFlags::DONTWAIT | RecvFlags::PEEK;
    // Without room for descriptors: that they are there is said, and none is made ours.
    let mut none = RecvAncillaryBuffer::default();
    match recvmsg(socket, &mut [IoSliceMut::new(rings)], &mut none, flags) {
        Ok(got) if got.flags.contains(ReturnFlags::CTRUNC) => None,
        Ok(got) => Some(got.bytes),
        // There is nothing, or will be nothing.
        Err(_) => Some(0),
    }
}

/// Waits for a bell's descriptor and for the peer's end.
fn poll_for(bell: &impl Doorbell, waiting: &Waiting<'_>) -> io::Result<Woken> {
    let Some(fd) = bell.fd() else {
        return Ok(Woken::Rung);
    };
    let left = timespec(waiting.left(Instant::now()));
    let ear = PollFd::from_borrowed_fd(fd, PollFlags::IN);
    let mut fds = [ear.clone(), waiting.hang_up.map_or(ear, end_of)];
    let count = if waiting.hang_up.is_some() { 2 } else { 1 };
    match poll(&mut fds[..count], Some(&left)) {
        Ok(0) => Ok(Woken::TimedOut),
        Ok(_) if fds[0].revents().contains(PollFlags::IN) && !hangs_up(fds[0].revents()) => {
            bell.drain();
            Ok(Woken::Rung)
        }
        Ok(_) => Ok(Woken::HungUp),
        // A signal came. The caller looks again.
        Err(Errno::INTR) => Ok(Woken::Rung),
        Err(errno) => Err(errno.into()),
    }
}

fn hangs_up(events: PollFlags) -> bool {
    events.intersects(PollFlags::HUP | PollFlags::ERR | PollFlags::NVAL)
}

fn end_of(hang_up: HangUp<'_>) -> PollFd<'_> {
    match hang_up {
        HangUp::Process(fd) => PollFd::from_borrowed_fd(fd, PollFlags::IN),
        HangUp::Socket(fd) => PollFd::from_borrowed_fd(fd, PollFlags::RDHUP),
    }
}

/// Whether the peer is gone. Does not wait.
pub(crate) fn has_ended(hang_up: HangUp<'_>) -> io::Result<bool> {
    first_ended(&mut [end_of(hang_up)]).map(|ended| ended.is_some())
}

/// The first of those peers that are gone: one system call for all of them. Does not wait.
pub(crate) fn which_ended<'a>(hang_ups: impl Iterator<Item = HangUp<'a>>) -> io::Result<Option<usize>> {
    first_ended(&mut hang_ups.map(end_of).collect::<Vec<_>>())
}

fn first_ended(ends: &mut [PollFd<'_>]) -> io::Result<Option<usize>> {
    match poll(ends, Some(&timespec(Duration::ZERO))) {
        Ok(0) | Err(Errno::INTR) => Ok(None),
        Ok(_) => Ok(ends.iter().position(|end| !end.revents().is_empty())),
        Err(errno) => Err(errno.into()),
    }
}

/// Far more than a lifetime is a lifetime.
pub(super) fn timespec(time: Duration) -> Timespec {
    Timespec {
        tv_sec: i64::try_from(time.as_secs()).unwrap_or(i64::MAX).min(1 << 32),
        tv_nsec: i64::from(time.subsec_nanos()),
    }
}

#[cfg(test)]
mod tests;
