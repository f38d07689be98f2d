//! Unexpected descriptors and data that a peer has passed. Their sender can make the close take arbitrarily
//! long, so no thread of the application closes them.

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
use sinew_protocol::ring::{Exchange, ExchangeError};
use sinew_shm::{Consumer, Descriptors, Offer, Producer, Received, keep_urgent_in_line, set_descriptors};

use super::{descriptors::holds_data, hang_up};

/// Maximum number of threads that close such descriptors at the same time. While all are busy, further ones
/// stay open until the process ends.
pub(super) const CLOSING_MAX: usize = 16;
/// The closing threads of this process.
pub(super) static DEFERRED_CLOSE: DeferredClose = DeferredClose::new(0);
/// Bytes per read while a socket is drained.
const CHUNK: usize = 4 * 1024;

/// This side's end of a link's socket. Dropping it shuts the socket down and drains it. Otherwise a
/// descriptor that the peer passed with its offer or later could block the last close.
pub(super) struct PeerSocket(Arc<UnixStream>);

impl PeerSocket {
    pub(super) fn new(socket: UnixStream) -> Self {
        // This fails only if the descriptor is no socket. Data that has arrived already is included from now
        // on.
        let _ = keep_urgent_in_line(&socket);
        Self(Arc::new(socket))
    }
}

impl Deref for PeerSocket {
    type Target = Arc<UnixStream>;

    fn deref(&self) -> &Arc<UnixStream> {
        &self.0
    }
}

impl Drop for PeerSocket {
    fn drop(&mut self) {
        // No more data arrives after this.
        hang_up(&self.0);
        // spec: LNCL-18
        if holds_data(&self.0) {
            DEFERRED_CLOSE.close(PendingClose::In(self.0.clone()));
        }
    }
}

/// Drains descriptors out of a wake-up socket of this side that is no longer read. Linux from 6.16 on refuses
/// such descriptors, so there are none.
pub(super) fn empty_bell(bell: Option<BorrowedFd<'_>>) {
    let Some(bell) = bell else { return };
    if set_descriptors(bell, Descriptors::Refused).is_err() {
        empty(bell);
    }
}

fn empty(bell: BorrowedFd<'_>) {
    // Without a copy it is closed without draining.
    let Ok(copy) = bell.try_clone_to_owned() else { return };
    drop(PeerSocket::new(copy.into()));
}

/// Further copies of the descriptors that a peer has passed, and of the socket that it used. While the copies
/// live, no other close is the last one, and only the last close can block.
pub(super) struct ReceivedCopies(Option<(Vec<OwnedFd>, Arc<UnixStream>)>);

impl ReceivedCopies {
    pub(super) fn of(received: &mut Received, socket: &Arc<UnixStream>) -> Self {
        Self(Some((received.copies(), socket.clone())))
    }

    /// Releases the copies: all descriptors are the expected ones and in use, so closing a copy cannot block.
    pub(super) fn release(mut self) {
        self.0 = None;
    }
}

impl Drop for ReceivedCopies {
    fn drop(&mut self) {
        if let Some((copies, socket)) = self.0.take() {
            DEFERRED_CLOSE.close(PendingClose::Copies(copies, socket));
        }
    }
}

/// This side's half of a link that is not established yet. Dropping it drains its wake-up sockets, because
/// the peer has them from the offer on and could block the close.
pub(super) struct LocalHalf {
    /// Present until it is joined or dropped.
    exchange: Option<Exchange>,
}

impl LocalHalf {
    pub(super) const fn new(exchange: Exchange) -> Self {
        Self { exchange: Some(exchange) }
    }

    /// Returns both rings if the peer's half is valid.
    pub(super) fn join(mut self, theirs: Offer) -> Result<UnusedRings, ExchangeError> {
        let theirs = self.exchange.as_ref().expect("it is there until it is joined").accept(theirs)?;
        let rings = self.exchange.take().expect("it is there until it is joined").join(theirs);
        Ok(UnusedRings(Some(Box::new(rings))))
    }
}

impl Drop for LocalHalf {
    fn drop(&mut self) {
        if let Some(exchange) = &self.exchange {
            // spec: LNCL-18
            exchange.bells().into_iter().flatten().for_each(empty);
        }
    }
}

/// Both rings of a link that is not established yet. Dropping them drains their wake-up sockets.
pub(super) struct UnusedRings(Option<Box<(Producer, Consumer)>>);

impl UnusedRings {
    pub(super) fn take(mut self) -> (Producer, Consumer) {
        *self.0.take().expect("they are there until they are taken")
    }
}

impl Drop for UnusedRings {
    fn drop(&mut self) {
        if let Some(rings) = &self.0 {
            let (producer, consumer) = &**rings;
            // spec: LNCL-18
            [producer.fd(), consumer.fd()].into_iter().for_each(empty_bell);
        }
    }
}

/// An object with a close that may take long.
enum PendingClose {
    Copies(Vec<OwnedFd>, Arc<UnixStream>),
    /// A socket with unread data, to which no more data arrives.
    In(Arc<UnixStream>),
}

impl PendingClose {
    fn close(self) {
        match self {
            Self::Copies(copies, socket) => drop((copies, socket)),
            Self::In(socket) => {
                let mut chunk = [0; CHUNK];
                // Without room for descriptors the system closes them here.
                while recv(&*socket, &mut chunk[..], RecvFlags::DONTWAIT).is_ok_and(|(count, _)| count > 0) {}
            }
        }
    }
}

/// The threads that close such objects.
pub(super) struct DeferredClose {
    threads: AtomicUsize,
}

impl DeferredClose {
    /// Returns a counter that starts with this number of busy threads.
    pub(super) const fn new(threads: usize) -> Self {
        Self { threads: AtomicUsize::new(threads) }
    }

    /// Returns whether unexpected descriptors of a peer could be closed now. If they would stay open, no peer
    /// may pass any descriptor.
    pub(super) fn is_room(&self) -> bool {
        self.threads.load(Ordering::Relaxed) < CLOSING_MAX
    }

    /// Records that one thread is done.
    pub(super) fn done(&self) {
        self.threads.fetch_sub(1, Ordering::Relaxed);
    }

    fn close(&'static self, pending: PendingClose) {
        // Not only in the thread's closure: if the thread cannot start, the closure is dropped here.
        let held = Arc::new(Mutex::new(Some(pending)));
        let its = held.clone();
        let is_room = self.threads.fetch_add(1, Ordering::Relaxed) < CLOSING_MAX;
        let closing = is_room.then(|| {
            thread::Builder::new().name("sinew-closing".to_owned()).spawn(move || {
                let pending = its.lock().unwrap_or_else(PoisonError::into_inner).take();
                pending.into_iter().for_each(PendingClose::close);
                self.done();
            })
        });
        if !matches!(closing, Some(Ok(_))) {
            self.done();
            sinew_runtime::log::here!(error:
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
    use sinew_lncl::{
        slow_close::{self, SlowClose},
        testing::WATCHDOG,
    };
    use sinew_protocol::ring;

    /// Passes the descriptor, with one byte, and keeps no copy.
    fn pass(slow: &mut SlowClose, socket: &UnixStream) {
        let passed = slow.ours.take().expect("it is passed once");
        slow_close::pass(socket, &[1], passed).expect("it comes");
    }

    /// Asserts that a thread finishes `drop_it` before the peer that passed the descriptor releases it.
    fn assert_finishes(slow: SlowClose, drop_it: impl FnOnce() + Send + 'static) {
        let (report, reported) = sync_channel(1);
        thread::spawn(move || {
            drop_it();
            // The test has ended if this comes too late.
            let _ = report.send(());
        });
        assert_eq!(reported.recv_timeout(WATCHDOG), Ok(()));
        slow.release();
    }

    // spec: LNCL-18
    #[test]
    fn ending_link_does_not_close_unread_descriptors() {
        let (ours, theirs) = UnixStream::pair().unwrap();
        let mut slow = SlowClose::new();
        pass(&mut slow, &theirs);
        let ours = PeerSocket::new(ours);
        assert_finishes(slow, move || drop(ours));
    }

    // spec: LNCL-18
    #[test]
    fn ending_link_does_not_close_descriptors_of_urgent_byte() {
        let (ours, theirs) = UnixStream::pair().unwrap();
        let mut slow = SlowClose::new();
        let passed = slow.ours.take().expect("it is passed once");
        slow_close::pass_urgent(&theirs, passed).expect("it comes");
        let ours = PeerSocket::new(ours);
        assert_finishes(slow, move || drop(ours));
    }

    // spec: LNCL-18
    #[test]
    fn giving_up_link_does_not_close_descriptors_in_bells() {
        // Given: a half with wake-up sockets that accept descriptors, as all do before Linux 6.16, and a peer
        // that has received their offer.
        let (ours, theirs) = UnixStream::pair().unwrap();
        let (exchange, offer) = Exchange::prepare(ring::capacity(4_096), BellKind::Socket).unwrap();
        for bell in exchange.bells().into_iter().flatten() {
            let _ = set_descriptors(bell, Descriptors::Taken);
        }
        offer.send(&ours).unwrap();
        let offered = Exchange::receive(&theirs).unwrap().expect("it has come");
        let mut slow = [SlowClose::new(), SlowClose::new()];
        for (slow, bell) in slow.iter_mut().zip(&offered.descriptors()[1..]) {
            pass(slow, &bell.try_clone().unwrap().into());
        }
        // When:
        let [first, second] = slow;
        let half = LocalHalf::new(exchange);
        assert_finishes(first, move || drop(half));
        second.release();
    }

    // spec: LNCL-18
    #[test]
    fn excess_slow_descriptors_stay_open_without_waiting() {
        // Given: as many threads as may be that wait for a close.
        let closing: &DeferredClose = Box::leak(Box::new(DeferredClose::new(0)));
        let socket = || Arc::new(UnixStream::pair().unwrap().0);
        let mut held: Vec<_> = std::iter::repeat_with(SlowClose::new).take(CLOSING_MAX).collect();
        for slow in &mut held {
            assert!(closing.is_room());
            let passed = slow.ours.take().expect("it is passed once");
            closing.close(PendingClose::Copies(vec![passed.into()], socket()));
        }
        assert!(!closing.is_room());
        // When: one more object arrives.
        let (open, passed) = UnixStream::pair().unwrap();
        closing.close(PendingClose::Copies(vec![passed.into()], socket()));
        // Then: it stays open, and the others are closed when they can be.
        held.into_iter().for_each(SlowClose::release);
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
    fn dropping_bell_does_not_close_passed_descriptors() {
        let (ours, theirs) = UnixStream::pair().unwrap();
        let mut slow = SlowClose::new();
        pass(&mut slow, &theirs);
        assert_finishes(slow, move || {
            // The answer of a system that cannot refuse descriptors.
            empty(ours.as_fd());
            drop(ours);
        });
    }
}
