//! The three bells: a futex, an eventfd, a socket pair.

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
    mapping::{Mapping, OwnHeaderMemory, PeerPlace},
    memfd::{adopt_own_page, adopt_page, create_own_page, create_page},
    rights::{keep_urgent_in_line, set_descriptors},
};
use crate::{
    bell::{Bell, BellKind, BellState, Bells, Doorbell, Woken},
    error::{CreateError, OfferError},
    layout::Word,
    memory::OwnHeader,
    offer::Descriptors,
    wait::{HangUp, Waiting},
    wait_set::READY_WORDS,
};

/// For messages, and for room.
type Both = (Box<dyn Doorbell>, Box<dyn Doorbell>);

/// Creates a region's bells.
pub(crate) fn bells(bell: &Bell) -> Result<Bells, CreateError> {
    let made = match bell {
        Bell::OfItsOwn(BellKind::Futex) => SharedPage::create().and_then(|page| {
            let (message, room) = page.bells();
            Ok(Bells { message, room, buttons: vec![page.descriptor()?], slot: None })
        }),
        Bell::OfItsOwn(BellKind::EventFd) => pair_of(event),
        Bell::OfItsOwn(BellKind::Socket) => pair_of(socket),
        Bell::OfItsOwn(BellKind::Set) => Err(io::ErrorKind::InvalidInput.into()),
        Bell::Set(set) => return set.join().map_err(not_made)?.ok_or(CreateError::SetFull),
    };
    made.map_err(not_made)
}

const fn not_made(cause: io::Error) -> CreateError {
    CreateError::System { step: "making bells", cause }
}

/// A page of futexes and of the bits of a set.
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

    pub(crate) fn bells(&self) -> Both {
        on_page(Arc::clone(&self.page))
    }

    pub(crate) fn descriptor(&self) -> io::Result<OwnedFd> {
        self.memory.try_clone()
    }

    /// The word that a ring for messages changes.
    pub(crate) fn message_word(&self) -> &AtomicU32 {
        self.page.shared_word(MESSAGE_WORD)
    }

    /// The bits of a set.
    pub(crate) fn reports(&self) -> &[AtomicU32] {
        self.page.shared_words(REPORT_WORD, READY_WORDS)
    }
}

/// The page in which the owner of a set announces its sleep.
#[derive(Debug)]
pub(crate) struct Announcement {
    page: OwnHeaderMemory,
    memory: OwnedFd,
}

impl Announcement {
    pub(crate) fn create() -> io::Result<Self> {
        let (page, memory) = create_own_page()?;
        Ok(Self { page, memory })
    }

    pub(crate) fn descriptor(&self) -> io::Result<OwnedFd> {
        self.memory.try_clone()
    }
}

impl OwnHeader for Announcement {
    fn store(&self, word: Word, value: u32, order: Ordering) {
        self.page.store(word, value, order);
    }
}

fn on_page(page: Arc<Mapping>) -> Both {
    let bell = |index| Box::new(FutexBell { page: Arc::clone(&page), index });
    (bell(MESSAGE_WORD), bell(ROOM_WORD))
}

fn pair_of<T: Doorbell + 'static>(make: fn() -> io::Result<(T, OwnedFd)>) -> io::Result<Bells> {
    let ((message, message_button), (room, room_button)) = (make()?, make()?);
    let buttons = vec![message_button, room_button];
    Ok(Bells { message: Box::new(message), room: Box::new(room), buttons, slot: None })
}

fn event() -> io::Result<(EventBell, OwnedFd)> {
    let listener = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?;
    let button = rustix::io::fcntl_dupfd_cloexec(&listener, 0)?;
    Ok((EventBell(listener), button))
}

fn socket() -> io::Result<(SocketBell, OwnedFd)> {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    let (listener, button) = socketpair(AddressFamily::UNIX, SocketType::STREAM, flags, None)?;
    // Draining the listener would close descriptors. If the system cannot refuse them (Linux before 6.16), the
    // listener is peeked first.
    let peeks = set_descriptors(listener.as_fd(), Descriptors::Refused).is_err();
    keep_urgent_in_line(listener.as_fd())?;
    Ok((SocketBell { socket: listener, peeks }, button))
}

/// This side's ends of a peer's bells.
pub(crate) struct Buttons {
    pub(crate) message: Box<dyn Doorbell>,
    pub(crate) room: Box<dyn Doorbell>,
    /// The place of this side's ring in the peer's set.
    pub(crate) place: Option<PeerPlace>,
}

impl From<Both> for Buttons {
    fn from((message, room): Both) -> Self {
        Self { message, room, place: None }
    }
}

/// Creates this side's ends of the peer's bells, if the descriptors are valid. `slot` is the place in the peer's set.
pub(crate) fn buttons(kind: BellKind, slot: u8, fds: Vec<OwnedFd>) -> Result<Buttons, OfferError> {
    let system = |cause| OfferError::System { step: "mapping the offered page of bells", cause };
    let mut fds = fds.into_iter();
    let both: Both = match (kind, fds.next(), fds.next()) {
        (BellKind::Set, Some(shared), Some(announcement)) => {
            let shared = adopt_page(&shared).map_err(system)?.ok_or(OfferError::NotABell(kind))?;
            let announcement = adopt_own_page(&announcement).map_err(system)?;
            let announcement = announcement.ok_or(OfferError::NotABell(kind))?;
            let shared = Arc::new(shared);
            let (message, room) = on_page(Arc::clone(&shared));
            let place = Some(PeerPlace::new(shared, Arc::new(announcement), slot));
            return Ok(Buttons { message, room, place });
        }
        (BellKind::Futex, Some(fd), None) => {
            let page = adopt_page(&fd).map_err(system)?;
            page.map(Arc::new).map(on_page).ok_or(OfferError::NotABell(kind))?
        }
        (BellKind::EventFd, Some(message), Some(room)) if is_eventfd(&message)? && is_eventfd(&room)? => {
            (Box::new(EventBell(message)), Box::new(EventBell(room)))
        }
        (BellKind::Socket, Some(message), Some(room)) if is_button(&message) && is_button(&room) => {
            (Box::new(button(message)), Box::new(button(room)))
        }
        (BellKind::Futex | BellKind::EventFd | BellKind::Socket | BellKind::Set, _, _) => {
            return Err(OfferError::NotABell(kind));
        }
    };
    Ok(both.into())
}

/// Whether it is a connected unix socket with an empty receive queue: descriptors in the queue would be
/// closed with it. Shuts down its receiving direction. A button is rung and never read, and no copy that the
/// peer has kept can undo the shutdown.
fn is_button(fd: &OwnedFd) -> bool {
    // A socket without another end could listen, now or later, and its queued connections would be closed
    // with it.
    let is_end = sockopt::socket_domain(fd) == Ok(AddressFamily::UNIX)
        && sockopt::socket_type(fd) == Ok(SocketType::STREAM)
        && getpeername(fd).is_ok();
    if !is_end {
        return false;
    }
    // It fails if the other end has gone, from which no data arrives either.
    let _ = shutdown(fd, Shutdown::Read);
    // Counted, not peeked: a peek skips an urgent byte, and data before the offset that the peer has set for
    // peeks.
    ioctl_fionread(fd) == Ok(0)
}

fn is_eventfd(fd: &OwnedFd) -> Result<bool, OfferError> {
    let name = readlink(format!("/proc/self/fd/{}", fd.as_raw_fd()), Vec::new());
    let name = name.map_err(|errno| OfferError::System {
        step: "asking what the offered bell is (/proc/self/fd)",
        cause: errno.into(),
    })?;
    Ok(name.as_bytes() == b"anon_inode:[eventfd]")
}

/// Interval at which a sleeper on a futex checks whether the peer is still present: one call cannot wait for
/// a futex and a descriptor.
const HANG_UP_CHECK: Duration = Duration::from_millis(20);

const MESSAGE_WORD: usize = 0;
const ROOM_WORD: usize = 32;
/// The first word of the bits of a set.
pub(super) const REPORT_WORD: usize = 64;

/// Wakes one sleeper at a word.
pub(super) fn wake(word: &AtomicU32) {
    // Not private: the sleeper is in another process. It can fail only for a bad address, which this is not.
    let _ = futex::wake(word, futex::Flags::empty(), 1);
}

/// A word that each ring changes, in a page that both sides write.
///
/// Not the tail or head itself: the sleeper's mapping of those is read-only, and a futex on a read-only
/// mapping costs half a microsecond more each time. A hostile peer's writes here end sleeps early, or lose
/// rings. These are its own rings, and where several regions share the page, those of others until `Waiter`
/// has detected that.
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
        // SYNC: a sleeper that sees this ring in `listen` also sees the stores before it.
        self.counter().fetch_add(1, Ordering::Release);
        wake(self.counter());
    }

    fn listen(&self) -> BellState {
        BellState(self.counter().load(Ordering::Acquire))
    }

    fn sleep(&self, seen: BellState, waiting: &Waiting<'_>) -> io::Result<Woken> {
        let left = waiting.left(Instant::now());
        let now = waiting.hang_up.map_or(left, |_| left.min(HANG_UP_CHECK));
        match futex::wait(self.counter(), futex::Flags::empty(), seen.0, Some(&timespec(now))) {
            // Rung before the sleep, or interrupted by a signal. The caller checks again.
            Ok(()) | Err(Errno::AGAIN | Errno::INTR) => return Ok(Woken::Rung),
            Err(Errno::TIMEDOUT) => {}
            Err(errno) => return Err(errno.into()),
        }
        if waiting.hang_up.map_or(Ok(false), has_ended)? {
            Ok(Woken::HungUp)
        } else if now == left {
            Ok(Woken::TimedOut)
        } else {
            // The caller checks again: another writer of the word may have undone the ring by restoring the
            // number.
            Ok(Woken::Rung)
        }
    }

    fn fd(&self) -> Option<BorrowedFd<'_>> {
        None
    }

    fn drain(&self) {
        // A futex stores no rings.
    }
}

/// A descriptor stores a ring until it is drained.
const STATE_IN_THE_DESCRIPTOR: BellState = BellState(0);

struct EventBell(OwnedFd);

impl Doorbell for EventBell {
    fn ring(&self) {
        // Full means that it is rung already.
        let _ = rustix::io::write(&self.0, &1_u64.to_ne_bytes());
    }

    fn listen(&self) -> BellState {
        STATE_IN_THE_DESCRIPTOR
    }

    fn sleep(&self, _: BellState, waiting: &Waiting<'_>) -> io::Result<Woken> {
        poll_for(self, waiting)
    }

    fn fd(&self) -> Option<BorrowedFd<'_>> {
        Some(self.0.as_fd())
    }

    fn drain(&self) {
        // Not a plain read: the peer may have made the shared descriptor blocking.
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
    /// Whether descriptors may arrive with the rings.
    peeks: bool,
}

/// Creates a button for the peer's bell, which is never read.
const fn button(socket: OwnedFd) -> SocketBell {
    SocketBell { socket, peeks: false }
}

impl Doorbell for SocketBell {
    fn ring(&self) {
        // Full means that it is rung already; closed means that no sleeper is left.
        let _ = send(&self.socket, &[1], SendFlags::DONTWAIT | SendFlags::NOSIGNAL);
    }

    fn listen(&self) -> BellState {
        STATE_IN_THE_DESCRIPTOR
    }

    fn sleep(&self, _: BellState, waiting: &Waiting<'_>) -> io::Result<Woken> {
        if self.peeks && undescribed(&self.socket, &mut [0; RINGS_MAX]).is_none() {
            // The descriptor would end every sleep, and a thread that must not block cannot remove it.
            return Ok(Woken::HungUp);
        }
        poll_for(self, waiting)
    }

    fn fd(&self) -> Option<BorrowedFd<'_>> {
        Some(self.socket.as_fd())
    }

    fn drain(&self) {
        let mut rings = [0; RINGS_MAX];
        let count = if self.peeks { undescribed(&self.socket, &mut rings) } else { Some(RINGS_MAX) };
        if let Some(count) = count {
            let _ = recv(&self.socket, &mut rings[..count], RecvFlags::DONTWAIT);
        }
    }
}

/// Bytes that are drained at once. Only a peer that rings without need exceeds this; then the next sleep ends
/// early.
const RINGS_MAX: usize = 64;

/// Peeks into the queue. Returns the number of bytes that can be read without a descriptor beside them;
/// `None` if there is one.
fn undescribed(socket: &OwnedFd, rings: &mut [u8]) -> Option<usize> {
    let flags = RecvFlags::DONTWAIT | RecvFlags::PEEK;
    // Without space for descriptors: the kernel reports their presence, and installs none in this process.
    let mut none = RecvAncillaryBuffer::default();
    match recvmsg(socket, &mut [IoSliceMut::new(rings)], &mut none, flags) {
        Ok(got) if got.flags.contains(ReturnFlags::CTRUNC) => None,
        Ok(got) => Some(got.bytes),
        // The queue is empty, or will stay empty.
        Err(_) => Some(0),
    }
}

/// Waits for a bell's descriptor and for the peer's end.
fn poll_for(bell: &impl Doorbell, waiting: &Waiting<'_>) -> io::Result<Woken> {
    let Some(fd) = bell.fd() else {
        return Ok(Woken::Rung);
    };
    let left = timespec(waiting.left(Instant::now()));
    let listener = PollFd::from_borrowed_fd(fd, PollFlags::IN);
    let mut fds = [listener.clone(), waiting.hang_up.map_or(listener, end_of)];
    let count = if waiting.hang_up.is_some() { 2 } else { 1 };
    match poll(&mut fds[..count], Some(&left)) {
        Ok(0) => Ok(Woken::TimedOut),
        Ok(_) if fds[0].revents().contains(PollFlags::IN) && !hangs_up(fds[0].revents()) => {
            bell.drain();
            Ok(Woken::Rung)
        }
        Ok(_) => Ok(Woken::HungUp),
        // Interrupted by a signal. The caller checks again.
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

/// Returns the first of those peers that are gone: one system call for all of them. Does not wait.
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

/// Converts a time; values far beyond a lifetime are capped.
pub(super) fn timespec(time: Duration) -> Timespec {
    Timespec {
        tv_sec: i64::try_from(time.as_secs()).unwrap_or(i64::MAX).min(1 << 32),
        tv_nsec: i64::from(time.subsec_nanos()),
    }
}

#[cfg(test)]
mod tests;
