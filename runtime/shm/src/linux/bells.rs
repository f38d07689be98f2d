//! The three bells: a futex on the word that changes, an eventfd, a pair of sockets.

use std::{
    io::{self, IoSliceMut},
    os::fd::{AsFd, AsRawFd, BorrowedFd, OwnedFd},
    sync::atomic::AtomicU32,
    time::{Duration, Instant},
};

use rustix::{
    event::{EventfdFlags, PollFd, PollFlags, eventfd, poll},
    fs::{Timespec, readlink},
    io::{Errno, ReadWriteFlags, preadv2},
    net::{AddressFamily, RecvFlags, SendFlags, SocketFlags, SocketType, recv, send, socketpair, sockopt},
    thread::futex,
};

use crate::{
    bell::{BellKind, BellPair, Doorbell, Sleeping, Woken},
    error::{CreateError, RefusedOffer},
    wait::{HangUp, Wait},
};

/// Both ends of a bell of this kind.
pub(crate) fn bell_pair(kind: BellKind) -> Result<BellPair, CreateError> {
    let made = match kind {
        BellKind::Futex => Ok(BellPair { ear: Box::new(FutexBell), button: None }),
        BellKind::EventFd => event_pair(),
        BellKind::Socket => socket_pair(),
    };
    made.map_err(|errno| CreateError::System { step: "making a bell", cause: errno.into() })
}

fn event_pair() -> Result<BellPair, Errno> {
    let ear = eventfd(0, EventfdFlags::CLOEXEC | EventfdFlags::NONBLOCK)?;
    let button = rustix::io::fcntl_dupfd_cloexec(&ear, 0)?;
    Ok(BellPair { ear: Box::new(EventBell(ear)), button: Some(button) })
}

fn socket_pair() -> Result<BellPair, Errno> {
    let flags = SocketFlags::CLOEXEC | SocketFlags::NONBLOCK;
    let (ear, button) = socketpair(AddressFamily::UNIX, SocketType::STREAM, flags, None)?;
    Ok(BellPair { ear: Box::new(SocketBell(ear)), button: Some(button) })
}

/// The peer's bell, to be rung by this side, if the descriptor is one.
pub(crate) fn button(kind: BellKind, fd: Option<OwnedFd>) -> Result<Box<dyn Doorbell>, RefusedOffer> {
    match (kind, fd) {
        (BellKind::Futex, _) => Ok(Box::new(FutexBell)),
        (BellKind::EventFd, Some(fd)) if is_eventfd(&fd)? => Ok(Box::new(EventBell(fd))),
        (BellKind::Socket, Some(fd)) if sockopt::socket_domain(&fd) == Ok(AddressFamily::UNIX) => {
            Ok(Box::new(SocketBell(fd)))
        }
        (BellKind::EventFd | BellKind::Socket, _) => Err(RefusedOffer::NotABell(kind)),
    }
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

struct FutexBell;

impl Doorbell for FutexBell {
    fn ring(&self, word: &AtomicU32) {
        // Not private: the sleeper is in another process. It can fail only for a bad address, which this is not.
        let _ = futex::wake(word, futex::Flags::empty(), 1);
    }

    fn sleep(&self, sleeping: &Sleeping<'_>) -> io::Result<Woken> {
        let Sleeping { word, seen, wait } = sleeping;
        loop {
            let left = wait.left(Instant::now());
            let now = wait.hang_up().map_or(left, |_| left.min(HANG_UP_LOOK));
            match futex::wait(word, futex::Flags::empty(), *seen, Some(&timespec(now))) {
                // The word has changed before the sleep; a signal came. The caller looks again.
                Ok(()) | Err(Errno::AGAIN | Errno::INTR) => return Ok(Woken::Rung),
                Err(Errno::TIMEDOUT) => {}
                Err(errno) => return Err(errno.into()),
            }
            if has_hung_up(wait)? {
                return Ok(Woken::HungUp);
            }
            if now == left {
                return Ok(Woken::TimedOut);
            }
        }
    }

    fn fd(&self) -> Option<BorrowedFd<'_>> {
        None
    }

    fn drain(&self) {
        // A futex keeps nothing.
    }
}

struct EventBell(OwnedFd);

impl Doorbell for EventBell {
    fn ring(&self, _word: &AtomicU32) {
        // Full means that it is rung already.
        let _ = rustix::io::write(&self.0, &1_u64.to_ne_bytes());
    }

    fn sleep(&self, sleeping: &Sleeping<'_>) -> io::Result<Woken> {
        poll_for(self, sleeping.wait)
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

struct SocketBell(OwnedFd);

impl Doorbell for SocketBell {
    fn ring(&self, _word: &AtomicU32) {
        // Full means that it is rung already; closed means that nobody waits.
        let _ = send(&self.0, &[1], SendFlags::DONTWAIT | SendFlags::NOSIGNAL);
    }

    fn sleep(&self, sleeping: &Sleeping<'_>) -> io::Result<Woken> {
        poll_for(self, sleeping.wait)
    }

    fn fd(&self) -> Option<BorrowedFd<'_>> {
        Some(self.0.as_fd())
    }

    fn drain(&self) {
        // More than this was rung only by a peer that rings for fun; then the next sleep ends early.
        let mut rings = [0; 64];
        let _ = recv(&self.0, &mut rings, RecvFlags::DONTWAIT);
    }
}

/// Waits for a bell's descriptor and for the peer's end.
fn poll_for(bell: &impl Doorbell, wait: &Wait<'_>) -> io::Result<Woken> {
    let Some(fd) = bell.fd() else {
        return Ok(Woken::Rung);
    };
    let left = timespec(wait.left(Instant::now()));
    let ear = PollFd::from_borrowed_fd(fd, PollFlags::IN);
    let mut fds = [ear.clone(), wait.hang_up().map_or(ear, end_of)];
    let count = if wait.hang_up().is_some() { 2 } else { 1 };
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

fn has_hung_up(wait: &Wait<'_>) -> io::Result<bool> {
    let Some(hang_up) = wait.hang_up() else {
        return Ok(false);
    };
    match poll(&mut [end_of(hang_up)], Some(&timespec(Duration::ZERO))) {
        Ok(count) => Ok(count > 0),
        Err(Errno::INTR) => Ok(false),
        Err(errno) => Err(errno.into()),
    }
}

/// Far more than a lifetime is a lifetime.
fn timespec(time: Duration) -> Timespec {
    Timespec {
        tv_sec: i64::try_from(time.as_secs()).unwrap_or(i64::MAX).min(1 << 32),
        tv_nsec: i64::from(time.subsec_nanos()),
    }
}
