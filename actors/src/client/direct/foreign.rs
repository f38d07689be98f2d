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
use sinew_shm::{Consumer, Descriptors, Offer, Producer, Received, keep_urgent_in_line, set_descriptors};

use super::{descriptors::holds_something, hang_up};
use crate::ring::{Exchange, ExchangeError};

/// Threads at most that close such things at once. What comes while all are at it stays open until the process ends.
pub(super) const CLOSING_MAX: usize = 16;
/// Those of this process.
pub(super) static CLOSING: Closing = Closing::new(0);
/// Bytes that are read at once from a socket that is emptied.
const CHUNK: usize = 4 * 1024;

/// This side's end of a link's socket. Dropped, it hangs up, and leaves nothing in the socket that could hold up who closes it last:
/// neither what a peer has passed beside its offer, nor before it was taken.
pub(super) struct LinkEnd(Arc<UnixStream>);

impl LinkEnd {
    pub(super) fn new(socket: UnixStream) -> Self {
        // It fails for what is no socket alone. What has come already is seen from now on, too.
        let _ = keep_urgent_in_line(&socket);
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
            CLOSING.close(Left::In(self.0.clone()));
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
            CLOSING.close(Left::Copies(copies, socket));
        }
    }
}

/// This side's half of a link that does not stand yet. Dropped, it leaves nothing in its bells that could hold up who closes them: the peer
/// has them from the moment in which they are offered.
pub(super) struct Half {
    /// There until it is joined, or dropped.
    exchange: Option<Exchange>,
}

impl Half {
    pub(super) const fn new(exchange: Exchange) -> Self {
        Self { exchange: Some(exchange) }
    }

    /// Both rings, if the peer's half is what it has to be.
    pub(super) fn join(mut self, theirs: Offer) -> Result<(Producer, Consumer), ExchangeError> {
        let theirs = self.exchange.as_ref().expect("it is there until it is joined").accept(theirs)?;
        Ok(self.exchange.take().expect("it is there until it is joined").join(theirs))
    }
}

impl Drop for Half {
    fn drop(&mut self) {
        if let Some(exchange) = &self.exchange {
            // spec: LNCL-18
            exchange.bells().into_iter().flatten().for_each(empty);
        }
    }
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

/// Threads that are rid of something.
pub(super) struct Closing {
    threads: AtomicUsize,
}

impl Closing {
    /// So many are at it already.
    pub(super) const fn new(threads: usize) -> Self {
        Self { threads: AtomicUsize::new(threads) }
    }

    /// Whether what a peer passes wrongly would be closed. Where it would stay open no peer is let pass anything.
    pub(super) fn is_room(&self) -> bool {
        self.threads.load(Ordering::Relaxed) < CLOSING_MAX
    }

    /// One of them is done.
    pub(super) fn done(&self) {
        self.threads.fetch_sub(1, Ordering::Relaxed);
    }

    fn close(&'static self, left: Left) {
        // Not in the thread's closure alone: where there is no thread that is dropped here.
        let held = Arc::new(Mutex::new(Some(left)));
        let its = held.clone();
        let is_room = self.threads.fetch_add(1, Ordering::Relaxed) < CLOSING_MAX;
        let closing = is_room.then(|| {
            thread::Builder::new().name("sinew-closing".to_owned()).spawn(move || {
                let left = its.lock().unwrap_or_else(PoisonError::into_inner).take();
                left.into_iter().for_each(Left::close);
                self.done();
            })
        });
        if !matches!(closing, Some(Ok(_))) {
            self.done();
            crate::log::here!(error:
                "a peer has passed descriptors that were not asked for; they stay open until this process ends"
            );
            std::mem::forget(held);
        }
    }
}

#[cfg(all(test, target_os = "linux"))]
mod tests {
    use std::{os::fd::AsFd, sync::mpsc::sync_channel};

    use rustix::io::Errno;
    use sinew_runtime::time::Time;
    use sinew_shm::BellKind;

    use super::*;
    use crate::{
        lingering::{self, Lingering},
        lncl::testing::WATCHDOG,
        ring,
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
    fn who_ends_a_link_does_not_wait_for_what_its_peer_has_passed_beside_an_urgent_byte() {
        let (ours, theirs) = UnixStream::pair().unwrap();
        let mut lingering = Lingering::new();
        let passed = lingering.ours.take().expect("it is passed once");
        lingering::pass_urgent(&theirs, passed).expect("it comes");
        let ours = LinkEnd::new(ours);
        is_done_with(lingering, move || drop(ours));
    }

    // spec: LNCL-18
    #[test]
    fn who_gives_up_a_link_does_not_wait_for_what_its_peer_has_passed_in_the_bells_that_it_was_offered() {
        // Given: a half whose bells take descriptors, as all do before Linux 6.16, and a peer that has been offered them.
        let (ours, theirs) = UnixStream::pair().unwrap();
        let (exchange, offer) = Exchange::prepare(ring::capacity(4_096), BellKind::Socket).unwrap();
        for bell in exchange.bells().into_iter().flatten() {
            let _ = set_descriptors(bell, Descriptors::Taken);
        }
        offer.send(&ours).unwrap();
        let offered = Exchange::receive(&theirs).unwrap().expect("it has come");
        let mut lingering = [Lingering::new(), Lingering::new()];
        for (lingering, bell) in lingering.iter_mut().zip(&offered.descriptors()[1..]) {
            pass(lingering, &bell.try_clone().unwrap().into());
        }
        // When:
        let [first, second] = lingering;
        let half = Half::new(exchange);
        is_done_with(first, move || drop(half));
        second.let_go();
    }

    // spec: LNCL-18
    #[test]
    fn what_comes_while_as_many_things_do_not_close_as_may_stays_open_and_nobody_waits_for_it() {
        // Given: as many threads as may be that wait for a close.
        let closing: &Closing = Box::leak(Box::new(Closing::new(0)));
        let socket = || Arc::new(UnixStream::pair().unwrap().0);
        let mut held: Vec<_> = std::iter::repeat_with(Lingering::new).take(CLOSING_MAX).collect();
        for lingering in &mut held {
            assert!(closing.is_room());
            let passed = lingering.ours.take().expect("it is passed once");
            closing.close(Left::Copies(vec![passed.into()], socket()));
        }
        assert!(!closing.is_room());
        // When: one thing more comes.
        let (open, passed) = UnixStream::pair().unwrap();
        closing.close(Left::Copies(vec![passed.into()], socket()));
        // Then: it stays open, and the others are closed when they can be.
        held.into_iter().for_each(Lingering::let_go);
        let deadline = Time::now() + WATCHDOG;
        while closing.threads.load(Ordering::Relaxed) > 0 {
            assert!(Time::now() < deadline, "waited for the threads");
            thread::yield_now();
        }
        assert!(closing.is_room());
        let unread = recv(&open, &mut [0; 1][..], RecvFlags::DONTWAIT);
        assert_eq!(unread.err(), Some(Errno::AGAIN), "nobody has closed the other end");
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
