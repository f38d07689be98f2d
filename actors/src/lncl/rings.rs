//! The thread `rings`: makes and maps the memory of clients' rings, and gives it back. Each of these takes the kernel a tenth of a
//! millisecond, and the thread that carries everybody's messages does not wait for it.
//!
//! It takes what it is given in that order, each thing for as long as it takes: what a hostile process has passed may take for ever to
//! close. Where more waits than may, nothing more is made: the client gets a plain socket. Where there is no such thread, who asks does it
//! himself.

use std::{
    ops::{Deref, DerefMut},
    sync::{
        Arc, Mutex,
        atomic::{AtomicUsize, Ordering},
        mpsc::{Receiver, SyncSender, TrySendError, sync_channel},
    },
    thread,
    time::{Duration, Instant},
};

#[cfg(target_os = "linux")]
use rustix::process::{getpriority_process, setpriority_process};
use sinew_runtime::supervision::make_ordinary;
use tokio::sync::oneshot;

use crate::stores::lock;

/// Things that wait for the thread when something is to be made, at most: four for each of 64 addresses that come or go at once.
const WAITING_MAX: usize = 256;
/// Things that wait for it in all, with those that are to be given back: three for each of 1,280 clients. What is more is given back by who
/// has it.
const GIVEN_MAX: usize = 1_280 * 3 + WAITING_MAX;
/// What takes longer is said.
const SLOW: Duration = Duration::from_secs(1);
/// How much nicer it is than others: newcomers wait, not the messages of those who are there.
#[cfg(target_os = "linux")]
const NICER: i32 = 5;

type Task = Box<dyn FnOnce() + Send>;

/// Clones are the same thread. It ends when there are none any more, after what it was given.
#[derive(Clone)]
pub(super) struct Rings(Arc<Hold>);

/// What keeps the thread.
struct Hold {
    /// `None`: there is no thread.
    tasks: Option<SyncSender<Task>>,
    queue: Arc<Queue>,
}

/// What is known of the thread.
#[derive(Default)]
struct Queue {
    waiting: AtomicUsize,
    /// Since when the task at hand is done, unless that was said to be long.
    since: Mutex<Option<Instant>>,
}

impl Rings {
    /// Begins the thread.
    pub(super) fn begin() -> Self {
        let (sender, tasks) = sync_channel(GIVEN_MAX);
        let queue = Arc::new(Queue::default());
        let its_queue = queue.clone();
        match thread::Builder::new().name("rings".to_owned()).spawn(move || work(tasks, &its_queue)) {
            Ok(_) => Self(Arc::new(Hold { tasks: Some(sender), queue })),
            Err(cause) => {
                crate::log::warn!(%cause, "no thread makes the rings of clients: each newcomer holds up others; raise `ulimit -u`");
                Self(Arc::new(Hold { tasks: None, queue }))
            }
        }
    }

    /// Runs `work` there. `None` if it panicked, or if too much waits: then `work` is dropped here, and what of it may take long to
    /// drop must be kept. Dropped, it is run all the same, and what it gives is dropped there.
    pub(super) async fn run<R: Send + 'static>(
        &self,
        work: impl FnOnce() -> R + Send + 'static,
    ) -> Option<R> {
        if self.0.tasks.is_some() && self.0.queue.waiting.load(Ordering::Relaxed) >= WAITING_MAX {
            self.0.queue.say_if_slow();
            return None;
        }
        let (sender, mut done) = oneshot::channel();
        // Who has asked may have gone: then it is dropped here.
        self.give(Box::new(move || drop(sender.send(work()))));
        if let Ok(done) = tokio::time::timeout(SLOW, &mut done).await {
            return done.ok();
        }
        self.0.queue.say_if_slow();
        done.await.ok()
    }

    /// `what`, which is dropped there.
    pub(super) fn keep<T: Send + 'static>(&self, what: T) -> Kept<T> {
        Kept { what: Some(what), rings: self.clone() }
    }

    fn give(&self, task: Task) {
        let Hold { tasks: Some(tasks), queue } = &*self.0 else { return task() };
        queue.waiting.fetch_add(1, Ordering::Relaxed);
        // It is there as long as its sender, unless a task has panicked.
        if let Err(TrySendError::Full(task) | TrySendError::Disconnected(task)) = tasks.try_send(task) {
            queue.waiting.fetch_sub(1, Ordering::Relaxed);
            task();
        }
    }
}

impl Queue {
    /// Says once of the task at hand that it takes long.
    fn say_if_slow(&self) -> bool {
        let is_slow = lock(&self.since).take_if(|since| since.elapsed() >= SLOW).is_some();
        if is_slow {
            let waiting = self.waiting.load(Ordering::Relaxed);
            crate::log::warn!(
                waiting,
                "the thread that makes rings has been at one thing for over {SLOW:?}: a client has passed a descriptor that does not close, or the machine is short of memory; who registers meanwhile gets a plain socket"
            );
        }
        is_slow
    }

    fn run(&self, task: Task) {
        self.waiting.fetch_sub(1, Ordering::Relaxed);
        *lock(&self.since) = Some(Instant::now());
        task();
        *lock(&self.since) = None;
    }
}

/// Something that its thread drops, whoever has it.
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
            self.rings.give(Box::new(move || drop(what)));
        }
    }
}

fn work(tasks: Receiver<Task>, queue: &Queue) {
    give_way();
    tasks.into_iter().for_each(|task| queue.run(task));
}

/// Makes the calling thread nicer than who made it, who may have a real-time priority besides.
fn give_way() {
    // Both are about the calling thread, whatever their names say. It goes on as it is where the system refuses it.
    #[cfg(target_os = "linux")]
    let nice = getpriority_process(None);
    make_ordinary();
    #[cfg(target_os = "linux")]
    if let Ok(nice) = nice {
        let _ = setpriority_process(None, nice + NICER);
    }
}

#[cfg(test)]
mod tests {
    use std::{
        sync::mpsc::{RecvTimeoutError, SyncSender, sync_channel},
        thread::{Thread, ThreadId, current},
    };

    use super::*;
    use crate::lncl::testing::WATCHDOG;

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

    /// Holds the thread until the sender is dropped.
    fn hold(rings: &Rings) -> SyncSender<()> {
        let (release, released) = sync_channel::<()>(0);
        let (begins, begun) = sync_channel(1);
        rings.give(Box::new(move || {
            begins.send(()).expect("the test listens");
            assert_eq!(released.recv_timeout(WATCHDOG), Err(RecvTimeoutError::Disconnected));
        }));
        begun.recv_timeout(WATCHDOG).expect("the thread takes it");
        release
    }

    #[test]
    fn what_is_made_is_made_and_dropped_on_a_thread_of_its_own() {
        let rings = Rings::begin();
        let thread: Thread = block_on(rings.run(current)).expect("no panic");
        assert_eq!(thread.name(), Some("rings"));
        let (what, dropped) = remains();
        drop(rings.keep(what));
        assert_eq!(dropped.recv_timeout(WATCHDOG), Ok(thread.id()));
    }

    #[test]
    fn who_has_gone_meanwhile_leaves_nothing() {
        // Given: somebody whose thing is not made yet.
        let rings = Rings::begin();
        let thread = block_on(rings.run(current)).expect("no panic");
        let held = hold(&rings);
        let (what, dropped) = remains();
        let mut asked = Box::pin(rings.run(move || what));
        assert!(block_on(async { futures_util::poll!(&mut asked) }).is_pending());
        // When:
        drop(asked);
        drop(held);
        // Then:
        assert_eq!(dropped.recv_timeout(WATCHDOG), Ok(thread.id()));
    }

    #[test]
    fn so_much_waits_and_nothing_more_is_made_nor_done_by_who_asks() {
        // Given: a thread that hangs, and as much as may wait for it.
        let rings = Rings::begin();
        let thread = block_on(rings.run(current)).expect("no panic");
        let held = hold(&rings);
        (0..WAITING_MAX).for_each(|_| rings.give(Box::new(|| ())));
        // When: more is to be made, and something is given back.
        let (asked, dropped) = remains();
        let asked = rings.keep(asked);
        assert!(block_on(rings.run(move || asked)).is_none());
        let (what, given_back) = remains();
        drop(rings.keep(what));
        // Then: both wait for the thread.
        assert!(dropped.try_recv().is_err() && given_back.try_recv().is_err());
        drop(held);
        assert_eq!(dropped.recv_timeout(WATCHDOG), Ok(thread.id()));
        assert_eq!(given_back.recv_timeout(WATCHDOG), Ok(thread.id()));
        assert!(block_on(rings.run(current)).is_some(), "there is room again");
    }

    #[test]
    fn what_takes_long_is_said_once() {
        let rings = Rings::begin();
        let _held = hold(&rings);
        assert!(!rings.0.queue.say_if_slow(), "it has just begun");
        *lock(&rings.0.queue.since) = Instant::now().checked_sub(SLOW);
        assert!(rings.0.queue.say_if_slow());
        assert!(!rings.0.queue.say_if_slow());
    }

    #[test]
    fn where_there_is_no_such_thread_any_more_nothing_is_lost() {
        let rings = Rings::begin();
        let fault = || -> u8 { std::panic::panic_any("planted") };
        assert_eq!(block_on(rings.run(fault)), None);
        // Its end is not told: what is given in that moment is dropped with its queue.
        let (what, dropped) = remains();
        drop(rings.keep(what));
        dropped.recv_timeout(WATCHDOG).expect("it is dropped");
    }
}
