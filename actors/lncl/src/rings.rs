//! Two threads that do slow work for the message thread, which waits for neither.
//!
//! `rings` creates and maps the memory of clients' rings, which takes a tenth of a millisecond each. If too many tasks
//! wait, no more rings are created, and the client gets a plain socket.
//!
//! `closing` drops the resources that clients leave behind: memory, bells and sockets. A descriptor that a client
//! passed may take forever to close, even if the node never read it. It lies in a socket's queue and is closed with
//! that socket, or is itself a socket with such a queue. If too many tasks wait, no connections are accepted until
//! there is room.
//!
//! If a thread could not be started, its work runs on the caller's thread.

use std::{
    ops::{Deref, DerefMut},
    sync::Arc,
};

use rustix::net::{RecvFlags, Shutdown, recv};
use tokio::{net::UnixStream, sync::oneshot};

use super::worker::{SLOW, Worker};

/// Bytes read at once from a socket that is emptied.
const CHUNK: usize = 4 * 1024;

/// Handle of both threads; clones share them. The threads finish their queued tasks and end after the last clone is
/// dropped.
#[derive(Clone)]
pub(super) struct Rings(Arc<Threads>);

struct Threads {
    making: Worker,
    closing: Worker,
}

impl Rings {
    /// Starts the threads, for `connections` connections at once.
    pub(super) fn begin(connections: usize) -> Self {
        let making = Worker::begin(
            connections,
            "rings",
            "clients that register meanwhile get a plain socket",
            "each new client delays others",
        );
        let closing = Worker::begin(
            connections,
            "closing",
            "the resources of other ended clients wait behind it",
            "a client that passes a descriptor that does not close delays others",
        );
        Self(Arc::new(Threads { making, closing }))
    }

    /// Runs `work` on the `rings` thread. Returns `None` if it panicked, or if too many tasks wait. In the latter case
    /// `work` is dropped here, so parts of it that drop slowly must be wrapped by [`Rings::keep`]. If this future is
    /// dropped, `work` still runs, and its result is dropped on that thread.
    pub(super) async fn run<R: Send + 'static>(
        &self,
        work: impl FnOnce() -> R + Send + 'static,
    ) -> Option<R> {
        let making = &self.0.making;
        if !making.has_room() {
            return None;
        }
        let (sender, mut done) = oneshot::channel();
        // If the caller is gone, the result is dropped here.
        making.submit(Box::new(move || drop(sender.send(work()))));
        if let Ok(done) = tokio::time::timeout(SLOW, &mut done).await {
            return done.ok();
        }
        making.queue.log_if_slow();
        done.await.ok()
    }

    /// Wraps `what`, so that it is dropped on the `closing` thread.
    pub(super) fn keep<T: Send + 'static>(&self, what: T) -> DropElsewhere<T> {
        DropElsewhere { what: Some(what), rings: self.clone() }
    }

    /// Returns whether the queue of the `closing` thread has room.
    pub(super) fn has_room(&self) -> bool {
        self.0.closing.has_room()
    }

    /// Ends a connection, and reads its unread data on the thread that may block. Any holder may then drop it on any
    /// thread.
    pub(super) fn empty(&self, stream: Arc<UnixStream>) {
        self.0.closing.submit(Box::new(move || {
            let mut chunk = [0; CHUNK];
            // Without a buffer for descriptors, the kernel closes them here. The loop ends, since no more data can
            // arrive.
            while recv(&*stream, &mut chunk[..], RecvFlags::DONTWAIT).is_ok_and(|(_, count)| count > 0) {}
        }));
    }
}

/// Ends a connection. Returns whether it holds unread data. [`Rings::empty`] must then read that before the last holder
/// drops the connection.
pub(super) fn shut(stream: &UnixStream) -> bool {
    // An error means that it is closed already.
    let _ = rustix::net::shutdown(stream, Shutdown::Both);
    // Peeks, so that descriptors beside the byte stay in the socket's queue.
    recv(stream, &mut [0; 1][..], RecvFlags::DONTWAIT | RecvFlags::PEEK).is_ok_and(|(_, count)| count > 0)
}

/// A value that is dropped on the `closing` thread, wherever its owner drops it.
pub(super) struct DropElsewhere<T: Send + 'static> {
    /// `Some` until the drop.
    what: Option<T>,
    rings: Rings,
}

impl<T: Send + 'static> DropElsewhere<T> {
    /// Returns the value. The caller drops it.
    pub(super) fn into_inner(mut self) -> T {
        self.what.take().expect("it is there until the drop")
    }
}

impl<T: Send + 'static> Deref for DropElsewhere<T> {
    type Target = T;

    fn deref(&self) -> &T {
        self.what.as_ref().expect("it is there until the drop")
    }
}

impl<T: Send + 'static> DerefMut for DropElsewhere<T> {
    fn deref_mut(&mut self) -> &mut T {
        self.what.as_mut().expect("it is there until the drop")
    }
}

impl<T: Send + 'static> Drop for DropElsewhere<T> {
    fn drop(&mut self) {
        if let Some(what) = self.what.take() {
            self.rings.0.closing.submit(Box::new(move || drop(what)));
        }
    }
}

#[cfg(test)]
mod tests {
    use std::{
        sync::mpsc::{Receiver, RecvTimeoutError, SyncSender, sync_channel},
        thread::{Thread, ThreadId, current},
        time::Instant,
    };

    use super::*;
    use crate::{testing::WATCHDOG, worker::WAITING_MAX};
    use sinew_runtime::lock;

    /// Reports the thread on which it is dropped.
    struct DropReporter(SyncSender<ThreadId>);

    impl Drop for DropReporter {
        fn drop(&mut self) {
            self.0.send(current().id()).expect("the test listens");
        }
    }

    fn drop_reporter() -> (DropReporter, Receiver<ThreadId>) {
        let (sender, dropped) = sync_channel(1);
        (DropReporter(sender), dropped)
    }

    fn block_on<R>(future: impl Future<Output = R>) -> R {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().expect("a runtime");
        runtime.block_on(future)
    }

    /// Holds a thread until the sender is dropped.
    fn hold(worker: &Worker) -> SyncSender<()> {
        let (release, released) = sync_channel::<()>(0);
        let (begins, begun) = sync_channel(1);
        worker.submit(Box::new(move || {
            begins.send(()).expect("the test listens");
            assert_eq!(released.recv_timeout(WATCHDOG), Err(RecvTimeoutError::Disconnected));
        }));
        begun.recv_timeout(WATCHDOG).expect("the thread takes it");
        release
    }

    /// Returns the thread that drops rings.
    fn closing(rings: &Rings) -> ThreadId {
        let (what, dropped) = drop_reporter();
        drop(rings.keep(what));
        dropped.recv_timeout(WATCHDOG).expect("it is dropped")
    }

    #[test]
    fn rings_are_made_and_dropped_on_separate_threads() {
        let rings = Rings::begin(1);
        let thread: Thread = block_on(rings.run(current)).expect("no panic");
        assert_eq!(thread.name(), Some("rings"));
        assert!(![thread.id(), current().id()].contains(&closing(&rings)));
    }

    #[test]
    fn cancelled_request_leaves_nothing() {
        // Given: a request in creation.
        let rings = Rings::begin(1);
        let held = hold(&rings.0.making);
        let (what, dropped) = drop_reporter();
        let what = rings.keep(what);
        let mut asked = Box::pin(rings.run(move || what));
        assert!(block_on(async { futures_util::poll!(&mut asked) }).is_pending());
        // When:
        drop(asked);
        drop(held);
        // Then:
        assert_eq!(dropped.recv_timeout(WATCHDOG), Ok(closing(&rings)));
    }

    #[test]
    fn waiting_work_is_bounded() {
        // Given: hung threads, and the maximum number of waiting tasks for them.
        let rings = Rings::begin(1);
        let closing = closing(&rings);
        let held = [&rings.0.making, &rings.0.closing].map(hold);
        (0..WAITING_MAX).for_each(|_| rings.0.making.submit(Box::new(|| ())));
        (1..WAITING_MAX).for_each(|_| rings.0.closing.submit(Box::new(|| ())));
        assert!(rings.has_room());
        // When: one more is requested, and dropped.
        let (asked, dropped) = drop_reporter();
        let asked = rings.keep(asked);
        assert!(block_on(rings.run(move || asked)).is_none());
        // Then: the drop waits for the thread.
        assert!(dropped.try_recv().is_err() && !rings.has_room());
        drop(held);
        assert_eq!(dropped.recv_timeout(WATCHDOG), Ok(closing));
        assert!(rings.has_room(), "there is room again");
    }

    #[test]
    fn simultaneous_ends_are_all_dropped_despite_a_slow_first() {
        // Given: the maximum number of configurable connections, and a blocked thread.
        const CONNECTIONS: usize = 4_096 + 1_024;
        let rings = Rings::begin(CONNECTIONS);
        let held = hold(&rings.0.closing);
        let left = Arc::new(());
        // When: all end, with both halves of their rings and an unread socket each.
        (0..3 * CONNECTIONS).for_each(|_| drop(rings.keep(left.clone())));
        drop(held);
        // Then:
        closing(&rings);
        assert_eq!(Arc::strong_count(&left), 1, "something is never given back");
    }

    #[test]
    fn hung_drop_thread_costs_newcomers_no_rings() {
        let rings = Rings::begin(1);
        let _held = hold(&rings.0.closing);
        drop(rings.keep(()));
        assert!(block_on(rings.run(current)).is_some());
    }

    #[test]
    fn slow_work_is_reported_once() {
        let rings = Rings::begin(1);
        let _held = hold(&rings.0.making);
        assert!(!rings.0.making.queue.log_if_slow(), "it has just begun");
        *lock(&rings.0.making.queue.since) = Instant::now().checked_sub(SLOW);
        assert!(rings.0.making.queue.log_if_slow());
        assert!(!rings.0.making.queue.log_if_slow());
    }

    #[test]
    fn panic_is_reported_and_the_thread_continues() {
        let rings = Rings::begin(1);
        let thread = block_on(rings.run(current)).expect("no panic");
        let fault = || -> u8 { std::panic::panic_any("planted") };
        assert_eq!(block_on(rings.run(fault)), None);
        assert_eq!(block_on(rings.run(current)).map(|thread| thread.id()), Some(thread.id()));
        assert!(rings.has_room());
    }
}
