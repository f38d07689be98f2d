//! Wakes of actors from any thread, also from one with destroyed thread-local variables.
//!
//! An actor is a task of a tokio `LocalSet`, and its waker reads tokio's thread-local variables. On a thread
//! that runs `atexit` handlers, or destructors of statics or of thread-local variables, these may be
//! destroyed. Then the wake panics, and the task counts as woken and never runs. Such a thread hands the wake
//! to this module's own thread instead.

use std::{
    collections::VecDeque,
    panic::catch_unwind,
    pin::Pin,
    sync::{Arc, Condvar, Mutex, OnceLock, PoisonError},
    task::{Context, Poll, Wake, Waker},
    thread,
};

use tokio::{runtime::Handle, task::LocalSet};

use crate::remedy::{Wanted, remedy};

/// Maximum number of pending wakes that were handed over; a thread that exceeds it waits for a free place.
/// Each is executed within microseconds.
const WAITING_MAX: usize = 256;

/// The waker of one task. Kept beside the task, so that a poll allocates nothing.
#[derive(Debug, Default)]
pub struct SafeWaker {
    cached: Option<(Waker, Waker)>,
}

impl SafeWaker {
    /// Returns a waker that wakes the task of `task` from any thread.
    #[inline]
    pub fn of(&mut self, task: &Waker) -> &Waker {
        if !self.cached.as_ref().is_some_and(|(cached, _)| cached.will_wake(task)) {
            self.cached = None;
        }
        let make = || {
            start();
            // On the task's own thread, where its thread-local variables exist: a wake at the end of this
            // thread then finds the order of destruction.
            let _ = are_thread_locals_alive();
            (task.clone(), Waker::from(Arc::new(Forward(task.clone()))))
        };
        &self.cached.get_or_insert_with(make).1
    }
}

/// A future that is a task of a `LocalSet`, woken by a [`SafeWaker`].
#[derive(Debug)]
pub struct SafelyWoken<F> {
    future: Pin<Box<F>>,
    waker: SafeWaker,
}

impl<F> SafelyWoken<F> {
    /// Wraps `future` before it is spawned.
    pub fn new(future: F) -> Self {
        Self { future: Box::pin(future), waker: SafeWaker::default() }
    }
}

impl<F: Future> Future for SafelyWoken<F> {
    type Output = F::Output;

    fn poll(mut self: Pin<&mut Self>, cx: &mut Context<'_>) -> Poll<F::Output> {
        let Self { future, waker } = &mut *self;
        future.as_mut().poll(&mut Context::from_waker(waker.of(cx.waker())))
    }
}

struct Forward(Waker);

impl Wake for Forward {
    fn wake(self: Arc<Self>) {
        self.wake_by_ref();
    }

    fn wake_by_ref(self: &Arc<Self>) {
        if are_thread_locals_alive() { self.0.wake_by_ref() } else { enqueue_late(self.0.clone()) }
    }
}

/// A sentinel; its destructor only makes the thread-local variable unavailable.
struct Sentinel;

impl Drop for Sentinel {
    fn drop(&mut self) {}
}

thread_local! {
    /// Destructors run in the reverse order of the first uses, so this one is destroyed before the variables
    /// that its initialisation uses.
    static SENTINEL: Option<Sentinel> = use_thread_locals_of_tokio().then_some(Sentinel);
}

/// Returns whether tokio's variables that a wake needs can be used on this thread, now and for the rest of this call.
fn are_thread_locals_alive() -> bool {
    SENTINEL.try_with(Option::is_some).unwrap_or(false)
}

/// Uses both thread-local variables that a wake uses. Returns whether they exist.
fn use_thread_locals_of_tokio() -> bool {
    if Handle::try_current().is_err_and(|error| error.is_thread_local_destroyed()) {
        return false;
    }
    // Panics on a thread that used a `LocalSet` itself and has destroyed its variable since: it never
    // received a wake there before.
    catch_unwind(|| drop(LocalSet::new().enter())).is_ok()
}

#[derive(Default)]
struct LateWakes {
    waiting: Mutex<VecDeque<Waker>>,
    /// Signals that a wake was handed over, or executed.
    changed: Condvar,
}

/// `None` if the thread could not be started.
static LATE_WAKES: OnceLock<Option<&'static LateWakes>> = OnceLock::new();

/// Starts the thread that executes such wakes, once per process. It is started in advance, because a thread
/// at its end may be unable to start one.
fn start() {
    LATE_WAKES.get_or_init(|| {
        let late_wakes: &LateWakes = Box::leak(Box::default());
        let run_wakes = || late_wakes.run_wakes();
        match thread::Builder::new().name("late-wakes".to_owned()).spawn(run_wakes) {
            Ok(_) => Some(late_wakes),
            Err(error) => {
                let remedy = remedy(Wanted::Thread, &error);
                crate::log::warn!(%error, %remedy, "no thread for wakes at the end of the process: stop the node before the end of `main`");
                None
            }
        }
    });
}

fn enqueue_late(waker: Waker) {
    match LATE_WAKES.get().copied().flatten() {
        Some(late_wakes) => late_wakes.enqueue_late(waker),
        // This may fail, and is better than no wake.
        None => waker.wake(),
    }
}

impl LateWakes {
    fn enqueue_late(&self, waker: Waker) {
        let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
        while waiting.len() >= WAITING_MAX {
            waiting = self.changed.wait(waiting).unwrap_or_else(PoisonError::into_inner);
        }
        waiting.push_back(waker);
        drop(waiting);
        self.changed.notify_all();
    }

    fn run_wakes(&self) -> ! {
        loop {
            let mut waiting = self.waiting.lock().unwrap_or_else(PoisonError::into_inner);
            let waker = loop {
                if let Some(waker) = waiting.pop_front() {
                    break waker;
                }
                waiting = self.changed.wait(waiting).unwrap_or_else(PoisonError::into_inner);
            };
            drop(waiting);
            self.changed.notify_all();
            // A foreign waker may panic: the next wakes are executed all the same.
            let _ = catch_unwind(|| waker.wake());
        }
    }
}

#[cfg(test)]
mod tests {
    use std::{
        cell::RefCell,
        sync::atomic::{AtomicUsize, Ordering},
        sync::mpsc::{SyncSender, sync_channel},
        time::Duration,
    };

    use super::*;

    const WATCHDOG: Duration = Duration::from_secs(60);

    /// Wakes when it is dropped.
    struct WakesLate(Waker);

    impl Drop for WakesLate {
        fn drop(&mut self) {
            self.0.wake_by_ref();
        }
    }

    thread_local! {
        static FIRST: RefCell<Option<WakesLate>> = const { RefCell::new(None) };
        static LAST: RefCell<Option<WakesLate>> = const { RefCell::new(None) };
    }

    /// A task that reports each poll after the first.
    fn task(polls: SyncSender<usize>) -> (thread::JoinHandle<()>, Waker) {
        let (give, given) = sync_channel(1);
        let count = AtomicUsize::new(0);
        let run = move || {
            let runtime = tokio::runtime::Builder::new_current_thread().build().expect("a runtime");
            let set = LocalSet::new();
            let mut safe = SafeWaker::default();
            set.block_on(
                &runtime,
                set.run_until(async {
                    let task = tokio::task::spawn_local(std::future::poll_fn(move |cx| {
                        let _ = give.try_send(safe.of(cx.waker()).clone());
                        let before = count.fetch_add(1, Ordering::Relaxed);
                        let _ = polls.send(before);
                        if before == 2 { Poll::Ready(()) } else { Poll::Pending }
                    }));
                    task.await.expect("it does not panic");
                }),
            );
        };
        let thread = thread::spawn(run);
        (thread, given.recv_timeout(WATCHDOG).expect("it is polled"))
    }

    #[test]
    fn task_is_woken_from_thread_local_destructors() {
        let (say, polls) = sync_channel(8);
        let (thread, waker) = task(say);
        assert_eq!(polls.recv_timeout(WATCHDOG), Ok(0));
        let wakes_late = WakesLate(waker.clone());
        thread::spawn(move || {
            // Used before tokio's, so destroyed after them.
            FIRST.with(|first| first.replace(Some(wakes_late)));
            drop(LocalSet::new().enter());
        })
        .join()
        .expect("it does not panic");
        assert_eq!(polls.recv_timeout(WATCHDOG), Ok(1));
        thread::spawn(move || {
            waker.wake_by_ref();
            LAST.with(|last| last.replace(Some(WakesLate(waker))));
        })
        .join()
        .expect("it does not panic");
        thread.join().expect("it was woken to its end");
    }
}
