//! Two threads beside the one that carries everybody's messages, which waits for neither.
//!
//! `rings` makes and maps the memory of clients' rings: a tenth of a millisecond each. Where more waits than may, nothing more is made: the client
//! gets a plain socket.
//!
//! `closing` gives back what clients have left: memory, bells, sockets. What a client has passed may take for ever to close, even where nobody
//! has asked for it and nobody has looked at it: it lies in a socket's queue, and goes with the socket, or is a socket with such a queue. Where more
//! waits than may, no connections are taken until there is room.
//!
//! Where there is no such thread, who asks does it himself.

use std::{
    ops::{Deref, DerefMut},
    sync::Arc,
};

use rustix::net::{RecvFlags, Shutdown, recv};
use tokio::{net::UnixStream, sync::oneshot};

use super::worker::{SLOW, Worker};

/// Bytes that are read at once from a socket that is given back.
const CHUNK: usize = 4 * 1024;

/// Clones are the same threads. They end when there are none any more, after what they were given.
#[derive(Clone)]
pub(super) struct Rings(Arc<Threads>);

struct Threads {
    making: Worker,
    closing: Worker,
}

impl Rings {
    /// Begins the threads, for so many connections at once.
    pub(super) fn begin(connections: usize) -> Self {
        let making = Worker::begin(
            connections,
            "rings",
            "who registers meanwhile gets a plain socket",
            "each newcomer holds up others",
        );
        let closing = Worker::begin(
            connections,
            "closing",
            "what other clients leave waits behind it",
            "who passes a descriptor that does not close holds up others",
        );
        Self(Arc::new(Threads { making, closing }))
    }

    /// Runs `work` on the thread that makes. `None` if it panicked, or if too much waits: then `work` is dropped here, and what of it may
    /// take long to drop must be kept. Dropped, it is run all the same, and what it gives is dropped there.
    pub(super) async fn run<R: Send + 'static>(
        &self,
        work: impl FnOnce() -> R + Send + 'static,
    ) -> Option<R> {
        let making = &self.0.making;
        if !making.has_room() {
            return None;
        }
        let (sender, mut done) = oneshot::channel();
        // Who has asked may have gone: then it is dropped here.
        making.give(Box::new(move || drop(sender.send(work()))));
        if let Ok(done) = tokio::time::timeout(SLOW, &mut done).await {
            return done.ok();
        }
        making.queue.say_if_slow();
        done.await.ok()
    }

    /// `what`, which is dropped on the thread that gives back.
    pub(super) fn keep<T: Send + 'static>(&self, what: T) -> Kept<T> {
        Kept { what: Some(what), rings: self.clone() }
    }

    /// Whether no more waits to be given back than may.
    pub(super) fn has_room(&self) -> bool {
        self.0.closing.has_room()
    }

    /// Ends a connection, and takes what is unread in it out where that may take long. Whoever still holds it may drop it anywhere then.
    pub(super) fn empty(&self, stream: Arc<UnixStream>) {
        self.0.closing.give(Box::new(move || {
            let mut chunk = [0; CHUNK];
            // Without room for descriptors: the system closes them here. It ends, since nothing more can come.
            while recv(&*stream, &mut chunk[..], RecvFlags::DONTWAIT).is_ok_and(|(_, count)| count > 0) {}
        }));
    }
}

/// Ends a connection. Returns whether something is unread in it, which must then be taken out by [`Rings::empty`] before the last one who holds it
/// drops it.
pub(super) fn shut(stream: &UnixStream) -> bool {
    // An error says that it is closed already.
    let _ = rustix::net::shutdown(stream, Shutdown::Both);
    // Looked at, not taken: what is beside the byte stays where it is.
    recv(stream, &mut [0; 1][..], RecvFlags::DONTWAIT | RecvFlags::PEEK).is_ok_and(|(_, count)| count > 0)
}

/// Something that the thread which gives back drops, whoever has it.
pub(super) struct Kept<T: Send + 'static> {
    /// There until the drop.
    what: Option<T>,
    rings: Rings,
}

impl<T: Send + 'static> Kept<T> {
    /// The thing itself. Who takes it drops it.
    pub(super) fn into_inner(mut self) -> T {
        self.what.take().expect("it is there until the drop")
    }
}

impl<T: Send + 'static> Deref for Kept<T> {
    type Target = T;

    fn deref(&self) -> &T {
        self.what.as_ref().expect("it is there until the drop")
    }
}

impl<T: Send + 'static> DerefMut for Kept<T> {
    fn deref_mut(&mut self) -> &mut T {
        self.what.as_mut().expect("it is there until the drop")
    }
}

impl<T: Send + 'static> Drop for Kept<T> {
    fn drop(&mut self) {
        if let Some(what) = self.what.take() {
            self.rings.0.closing.give(Box::new(move || drop(what)));
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
    use crate::{
        lncl::{testing::WATCHDOG, worker::WAITING_MAX},
        stores::lock,
    };

    /// Tells on which thread it is dropped.
    struct Remains(SyncSender<ThreadId>);

    impl Drop for Remains {
        fn drop(&mut self) {
            self.0.send(current().id()).expect("the test listens");
        }
    }

    fn remains() -> (Remains, Receiver<ThreadId>) {
        let (sender, dropped) = sync_channel(1);
        (Remains(sender), dropped)
    }

    fn block_on<R>(future: impl Future<Output = R>) -> R {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().expect("a runtime");
        runtime.block_on(future)
    }

    /// Holds a thread until the sender is dropped.
    fn hold(worker: &Worker) -> SyncSender<()> {
        let (release, released) = sync_channel::<()>(0);
        let (begins, begun) = sync_channel(1);
        worker.give(Box::new(move || {
            begins.send(()).expect("the test listens");
            assert_eq!(released.recv_timeout(WATCHDOG), Err(RecvTimeoutError::Disconnected));
        }));
        begun.recv_timeout(WATCHDOG).expect("the thread takes it");
        release
    }

    /// The thread that gives back.
    fn closing(rings: &Rings) -> ThreadId {
        let (what, dropped) = remains();
        drop(rings.keep(what));
        dropped.recv_timeout(WATCHDOG).expect("it is dropped")
    }

    #[test]
    fn what_is_made_is_made_on_a_thread_of_its_own_and_given_back_on_another() {
        let rings = Rings::begin(1);
        let thread: Thread = block_on(rings.run(current)).expect("no panic");
        assert_eq!(thread.name(), Some("rings"));
        assert!(![thread.id(), current().id()].contains(&closing(&rings)));
    }

    #[test]
    fn who_has_gone_meanwhile_leaves_nothing() {
        // Given: somebody whose thing is not made yet.
        let rings = Rings::begin(1);
        let held = hold(&rings.0.making);
        let (what, dropped) = remains();
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
    fn so_much_waits_and_nothing_more_is_made_nor_done_by_who_asks() {
        // Given: threads that hang, and as much as may wait for them.
        let rings = Rings::begin(1);
        let closing = closing(&rings);
        let held = [&rings.0.making, &rings.0.closing].map(hold);
        (0..WAITING_MAX).for_each(|_| rings.0.making.give(Box::new(|| ())));
        (1..WAITING_MAX).for_each(|_| rings.0.closing.give(Box::new(|| ())));
        assert!(rings.has_room());
        // When: more is to be made, and is given back.
        let (asked, dropped) = remains();
        let asked = rings.keep(asked);
        assert!(block_on(rings.run(move || asked)).is_none());
        // Then: it waits for the thread.
        assert!(dropped.try_recv().is_err() && !rings.has_room());
        drop(held);
        assert_eq!(dropped.recv_timeout(WATCHDOG), Ok(closing));
        assert!(rings.has_room(), "there is room again");
    }

    #[test]
    fn what_all_leave_at_once_is_given_back_however_many_they_are_and_however_long_the_first_takes() {
        // Given: as many connections as can be configured, and a thread that is held up.
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
    fn who_makes_the_thread_hang_that_gives_back_costs_newcomers_no_rings() {
        let rings = Rings::begin(1);
        let _held = hold(&rings.0.closing);
        drop(rings.keep(()));
        assert!(block_on(rings.run(current)).is_some());
    }

    #[test]
    fn what_takes_long_is_said_once() {
        let rings = Rings::begin(1);
        let _held = hold(&rings.0.making);
        assert!(!rings.0.making.queue.say_if_slow(), "it has just begun");
        *lock(&rings.0.making.queue.since) = Instant::now().checked_sub(SLOW);
        assert!(rings.0.making.queue.say_if_slow());
        assert!(!rings.0.making.queue.say_if_slow());
    }

    #[test]
    fn a_fault_in_one_thing_is_told_and_the_thread_does_the_next_one() {
        let rings = Rings::begin(1);
        let thread = block_on(rings.run(current)).expect("no panic");
        let fault = || -> u8 { std::panic::panic_any("planted") };
        assert_eq!(block_on(rings.run(fault)), None);
        assert_eq!(block_on(rings.run(current)).map(|thread| thread.id()), Some(thread.id()));
        assert!(rings.has_room());
    }
}
