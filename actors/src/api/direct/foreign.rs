//! What a peer has passed that is none of what was to come, or more than that. To close it may take as long as its sender likes, so no
//! thread of the application's does.

use std::{
    ops::Deref,
    os::{
        fd::{BorrowedFd, OwnedFd},
        unix::net::UnixStream,
    },
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicUsize, Ordering},
    },
    thread,
};

use rustix::net::{RecvFlags, recv};
use sinew_shm::{Descriptors, Received, set_descriptors};

use super::{descriptors::holds_something, hang_up};

/// Threads at most that close such things at once. What comes while all are at it stays open until the process ends.
const CLOSING_MAX: usize = 16;
static CLOSING: AtomicUsize = AtomicUsize::new(0);
/// Bytes that are read at once from a socket that is emptied.
const CHUNK: usize = 4 * 1024;

/// This side's end of a link's socket. Dropped, it hangs up, and leaves nothing in the socket that could hold up who closes it last:
/// neither what a peer has passed beside its offer, nor before it was taken.
pub(super) struct LinkEnd(Arc<UnixStream>);

impl LinkEnd {
    pub(super) fn new(socket: UnixStream) -> Self {
        Self(Arc::new(socket))
    }
}

impl Deref for LinkEnd {
    type Target = Arc<UnixStream>;

    fn deref(&self) -> &Arc<UnixStream> {
        &self.0
    }
}

impl Drop for LinkEnd {
    fn drop(&mut self) {
        // Nothing more comes then.
        hang_up(&self.0);
        // spec: LNCL-18
        if holds_something(&self.0) {
            close(Left::In(self.0.clone()));
        }
    }
}

/// Has descriptors taken out of a bell of this side's that is heard no more. Where the system refuses them (Linux from 6.16 on) there are
/// none.
pub(super) fn empty_bell(bell: Option<BorrowedFd<'_>>) {
    let Some(bell) = bell else { return };
    if set_descriptors(bell, Descriptors::Refused).is_err() {
        empty(bell);
    }
}

fn empty(bell: BorrowedFd<'_>) {
    // Without a copy it is closed as it is.
    let Ok(copy) = bell.try_clone_to_owned() else { return };
    drop(LinkEnd::new(copy.into()));
}

/// Further copies of what a peer has passed, and of the socket over which it did. While they live nothing that becomes of the others is the
/// last close, the only one that can block.
pub(super) struct Foreign(Option<(Vec<OwnedFd>, Arc<UnixStream>)>);

impl Foreign {
    pub(super) fn of(received: &mut Received, socket: &Arc<UnixStream>) -> Self {
        Self(Some((received.copies(), socket.clone())))
    }

    /// All is what was to come, and in use: to close a copy of it waits for nobody.
    pub(super) fn are_good(mut self) {
        self.0 = None;
    }
}

impl Drop for Foreign {
    fn drop(&mut self) {
        if let Some((copies, socket)) = self.0.take() {
            close(Left::Copies(copies, socket));
        }
    }
}

/// Whether what a peer passes wrongly would be closed. Where it would stay open no peer is let pass anything.
pub(super) fn is_room() -> bool {
    CLOSING.load(Ordering::Relaxed) < CLOSING_MAX
}

/// What may take long to be rid of.
enum Left {
    Copies(Vec<OwnedFd>, Arc<UnixStream>),
    /// What is unread in a socket to which nothing more comes.
    In(Arc<UnixStream>),
}

impl Left {
    fn close(self) {
        match self {
            Self::Copies(copies, socket) => drop((copies, socket)),
            Self::In(socket) => {
                let mut chunk = [0; CHUNK];
                // Without room for descriptors: the system closes them here.
                while recv(&*socket, &mut chunk[..], RecvFlags::DONTWAIT).is_ok_and(|(count, _)| count > 0) {}
            }
        }
    }
}

fn close(left: Left) {
    // Not in the thread's closure alone: where there is no thread that is dropped here.
    let held = Arc::new(Mutex::new(Some(left)));
    let its = held.clone();
    let is_room = CLOSING.fetch_add(1, Ordering::Relaxed) < CLOSING_MAX;
    let closing = is_room.then(|| {
        thread::Builder::new().name("sinew-closing".to_owned()).spawn(move || {
            let left = its.lock().unwrap_or_else(PoisonError::into_inner).take();
            left.into_iter().for_each(Left::close);
            CLOSING.fetch_sub(1, Ordering::Relaxed);
        })
    });
    if !matches!(closing, Some(Ok(_))) {
        CLOSING.fetch_sub(1, Ordering::Relaxed);
        tracing::error!(
            "a peer has passed descriptors that were not asked for; they stay open until this process ends"
        );
        std::mem::forget(held);
    }
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use std::{os::fd::AsFd, sync::mpsc::sync_channel};

    use super::*;
    use crate::{
        lingering::{self, Lingering},
        lncl::testing::WATCHDOG,
    };

    /// Passes it, with one byte, and keeps no copy.
    fn pass(lingering: &mut Lingering, socket: &UnixStream) {
        let passed = lingering.ours.take().expect("it is passed once");
        lingering::pass(socket, &[1], passed).expect("it comes");
    }

    /// Whether a thread is done with it before the one who has passed it lets go.
    fn is_done_with(lingering: Lingering, drop_it: impl FnOnce() + Send + 'static) {
        let (say, said) = sync_channel(1);
        thread::spawn(move || {
            drop_it();
            // The test has ended, where this comes too late.
            let _ = say.send(());
        });
        assert_eq!(said.recv_timeout(WATCHDOG), Ok(()));
        lingering.let_go();
    }

    // spec: LNCL-18
    #[test]
    fn who_ends_a_link_does_not_wait_for_what_its_peer_has_passed_there_and_nobody_took() {
        let (ours, theirs) = UnixStream::pair().unwrap();
        let mut lingering = Lingering::new();
        pass(&mut lingering, &theirs);
        let ours = LinkEnd::new(ours);
        is_done_with(lingering, move || drop(ours));
    }

    // spec: LNCL-18
    #[test]
    fn who_hears_a_bell_no_more_does_not_wait_for_what_its_peer_has_passed_there() {
        let (ours, theirs) = UnixStream::pair().unwrap();
        let mut lingering = Lingering::new();
        pass(&mut lingering, &theirs);
        is_done_with(lingering, move || {
            // As a system says that does not know how to refuse them.
            empty(ours.as_fd());
            drop(ours);
        });
    }
}
