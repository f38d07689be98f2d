//! The thread `rings`: makes and maps the memory of clients' rings, and gives it back. Each of these takes the kernel a tenth of a
//! millisecond, and the thread that carries everybody's messages does not wait for it.
//!
//! It takes what it is given in that order, each thing for as long as it takes: what a hostile process has passed may take for ever to
//! close. Where more waits than may, or there is no such thread, who asks does it himself.

use std::{
    ops::{Deref, DerefMut},
    sync::mpsc::{Receiver, SyncSender, TrySendError, sync_channel},
    thread,
};

#[cfg(target_os = "linux")]
use rustix::process::{getpriority_process, setpriority_process};
use sinew_runtime::supervision::make_ordinary;
use tokio::sync::oneshot;

/// Things that wait for the thread at most: four for each of 64 addresses that come or go at once.
const WAITING_MAX: usize = 256;
/// How much nicer it is than others: newcomers wait, not the messages of those who are there.
#[cfg(target_os = "linux")]
const NICER: i32 = 5;

type Task = Box<dyn FnOnce() + Send>;

/// Clones are the same thread. It ends when there are none any more, after what it was given.
#[derive(Clone)]
pub(super) struct Rings(Option<SyncSender<Task>>);

impl Rings {
    /// Begins the thread.
    pub(super) fn begin() -> Self {
        let (sender, tasks) = sync_channel(WAITING_MAX);
        match thread::Builder::new().name("rings".to_owned()).spawn(move || work(tasks)) {
            Ok(_) => Self(Some(sender)),
            Err(cause) => {
                crate::log::warn!(%cause, "no thread makes the rings of clients: each newcomer holds up others; raise `ulimit -u`");
                Self(None)
            }
        }
    }

    /// Runs `work` there. `None` if it panicked. Dropped, it is run all the same, and what it gives is dropped there.
    pub(super) async fn run<R: Send + 'static>(
        &self,
        work: impl FnOnce() -> R + Send + 'static,
    ) -> Option<R> {
        let (sender, done) = oneshot::channel();
        // Who has asked may have gone: then it is dropped here.
        self.give(Box::new(move || drop(sender.send(work()))));
        done.await.ok()
    }

    /// `what`, which is dropped there.
    pub(super) fn keep<T: Send + 'static>(&self, what: T) -> Kept<T> {
        Kept { what: Some(what), rings: self.clone() }
    }

    fn give(&self, task: Task) {
        let Some(sender) = &self.0 else { return task() };
        // It is there as long as its sender, unless a task has panicked.
        if let Err(TrySendError::Full(task) | TrySendError::Disconnected(task)) = sender.try_send(task) {
            task();
        }
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

fn work(tasks: Receiver<Task>) {
    give_way();
    tasks.into_iter().for_each(|task| task());
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
        let runtime = tokio::runtime::Builder::new_current_thread().build().expect("a runtime");
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
    fn so_much_waits_and_what_is_more_is_done_by_who_asks() {
        let rings = Rings::begin();
        let _held = hold(&rings);
        (0..WAITING_MAX).for_each(|_| rings.give(Box::new(|| ())));
        assert_eq!(block_on(rings.run(current)).expect("no panic").id(), current().id());
        let (what, dropped) = remains();
        drop(rings.keep(what));
        assert_eq!(dropped.try_recv(), Ok(current().id()));
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
