//! The drop of user values that are no longer needed: on threads of their own, never on the node's root thread.
//!
//! A factory, its captures and the payload of a panic are user values, and so is their drop: it may take
//! long, never end, or panic. A supervisor must not wait for it.

use std::{
    any::Any,
    collections::{BTreeMap, VecDeque},
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{Arc, Condvar, Mutex, PoisonError},
    time::Duration,
};

use super::{panics::panic_message, set_normal_schedule};
use crate::{lock, log, thread::mark_runtime_thread, time::Time};

/// Maximum number of concurrent drops: fewer drops that never end block no others.
const THREADS_MAX: usize = 4;
/// Maximum number of waiting values. Further ones are leaked, which is logged.
const WAITING_MAX: usize = 4_096;
/// Time after which a drop is logged as slow.
const LONG: Duration = Duration::from_secs(1);

/// A queue of values that are dropped later on other threads. Clones share the queue.
#[derive(Clone, Default)]
pub struct DropQueue(Arc<Shared>);

#[derive(Default)]
struct Shared {
    state: Mutex<State>,
    /// Signals that a drop has ended, or that one more must be watched.
    changed: Condvar,
}

#[derive(Default)]
struct State {
    waiting: VecDeque<PendingDrop>,
    active: BTreeMap<u64, ActiveDrop>,
    count: u64,
    threads: usize,
    is_watched: bool,
}

/// A value that waits for its drop.
struct PendingDrop {
    owner: String,
    value: Box<dyn Any + Send>,
}

/// A drop in progress.
struct ActiveDrop {
    owner: String,
    since: Time,
    is_logged: bool,
}

impl std::fmt::Debug for DropQueue {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let state = lock(&self.0.state);
        write!(f, "DropQueue({} active, {} waiting)", state.active.len(), state.waiting.len())
    }
}

impl DropQueue {
    /// Queues `value`, which belongs to `owner`, for its drop on a thread called `deferred-drop`. Returns at
    /// once. A panic of the drop is caught, and a slow drop is logged. Slow drops block others only if there
    /// are four of them.
    pub fn push(&self, owner: impl Into<String>, value: impl Any + Send) {
        let pending = PendingDrop { owner: owner.into(), value: Box::new(value) };
        let mut state = lock(&self.0.state);
        if state.waiting.len() >= WAITING_MAX {
            let owner = pending.owner;
            std::mem::forget(pending.value);
            return log::error!(
                owner,
                WAITING_MAX,
                "the queue of deferred drops is full; this value is leaked"
            );
        }
        state.waiting.push_back(pending);
        if state.threads < THREADS_MAX && self.spawn("deferred-drop", Self::work) {
            state.threads += 1;
        }
        if !state.is_watched {
            state.is_watched = self.spawn("drop-watchdog", Self::watch);
        }
    }

    /// Waits until all queued values are dropped, or until `within` has passed. Returns whether they are.
    pub fn wait(&self, within: Duration) -> bool {
        let state = lock(&self.0.state);
        let waited = self.0.changed.wait_timeout_while(state, within, |state| !state.is_idle());
        let (state, _) = waited.unwrap_or_else(PoisonError::into_inner);
        state.is_idle()
    }

    fn spawn(&self, name: &str, work: fn(&Self)) -> bool {
        let drop_queue = self.clone();
        let begun = std::thread::Builder::new().name(name.to_owned()).spawn(move || {
            mark_runtime_thread();
            // The panicking thread may have a real-time priority.
            set_normal_schedule();
            work(&drop_queue);
        });
        if let Err(error) = &begun {
            // The waiting values are dropped after the next one.
            let remedy = crate::remedy::remedy(crate::remedy::Wanted::Thread, error);
            log::error!(%error, name, %remedy, "there is no thread for deferred drops");
        }
        begun.is_ok()
    }

    /// Drops one value after the other until the queue is empty.
    fn work(&self) {
        while let Some((number, pending)) = self.next() {
            let PendingDrop { owner, value } = pending;
            if let Err(panic) = catch_unwind(AssertUnwindSafe(|| drop(value))) {
                log::error!(
                    owner,
                    panic = panic_message(panic),
                    "a value of this actor panicked in its drop"
                );
            }
            lock(&self.0.state).active.remove(&number);
            self.0.changed.notify_all();
        }
    }

    /// Takes the next value. `None`: the queue is empty, and this thread is no longer counted.
    fn next(&self) -> Option<(u64, PendingDrop)> {
        let mut state = lock(&self.0.state);
        let Some(pending) = state.waiting.pop_front() else {
            state.threads -= 1;
            drop(state);
            self.0.changed.notify_all();
            return None;
        };
        state.count += 1;
        let number = state.count;
        let active = ActiveDrop { owner: pending.owner.clone(), since: Time::now(), is_logged: false };
        state.active.insert(number, active);
        Some((number, pending))
    }

    /// Logs slow drops, until no drop is in progress. Runs no user code, so it cannot block.
    fn watch(&self) {
        let mut state = lock(&self.0.state);
        while state.is_busy() {
            let late = state.take_late(Time::now());
            let waiting = state.waiting.len();
            if late.is_empty() {
                let waited = self.0.changed.wait_timeout(state, LONG);
                (state, _) = waited.unwrap_or_else(PoisonError::into_inner);
                continue;
            }
            for (owner, lasted) in late {
                log::error!(owner, ?lasted, waiting, "the drop of a value of this actor has not returned");
            }
        }
        state.is_watched = false;
    }
}

impl State {
    fn is_busy(&self) -> bool {
        self.threads > 0 || !self.active.is_empty()
    }

    fn is_idle(&self) -> bool {
        !self.is_busy() && self.waiting.is_empty()
    }

    /// Returns the slow drops that were not logged yet.
    fn take_late(&mut self, now: Time) -> Vec<(String, Duration)> {
        let late = self.active.values_mut().filter(|drop| !drop.is_logged && now.since(drop.since) >= LONG);
        let mark = |drop: &mut ActiveDrop| {
            drop.is_logged = true;
            (drop.owner.clone(), now.since(drop.since))
        };
        late.map(mark).collect()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

    use super::*;

    const PATIENCE: Duration = Duration::from_secs(20);

    /// Reports its drop, which blocks until it is released.
    struct Slow {
        report: SyncSender<Option<String>>,
        until: Receiver<()>,
    }

    impl Drop for Slow {
        fn drop(&mut self) {
            self.report.send(std::thread::current().name().map(str::to_owned)).expect("it is waited for");
            // The test may have dropped the other end.
            let _ = self.until.recv();
        }
    }

    struct Panics;

    impl Drop for Panics {
        fn drop(&mut self) {
            panic!("in its drop");
        }
    }

    fn slow() -> (Slow, Receiver<Option<String>>, SyncSender<()>) {
        let ((report, reported), (end, until)) = (sync_channel(1), sync_channel(1));
        (Slow { report, until }, reported, end)
    }

    #[test]
    fn value_is_dropped_on_a_reporting_thread_despite_panics() {
        let drop_queue = DropQueue::default();
        drop_queue.push("panics", Panics);
        let (value, reported, end) = slow();
        drop_queue.push("slow", value);
        assert_eq!(reported.recv_timeout(PATIENCE).expect("it is dropped").as_deref(), Some("deferred-drop"));
        assert!(!drop_queue.wait(Duration::from_millis(1)), "it is not dropped yet");
        end.send(()).expect("it waits for this");
        assert!(drop_queue.wait(PATIENCE));
    }

    #[test]
    fn endless_drops_are_reported_and_the_rest_continues() {
        let drop_queue = DropQueue::default();
        let mut ends = Vec::new();
        for _ in 0..THREADS_MAX {
            let (value, reported, end) = slow();
            drop_queue.push("slow", value);
            reported.recv_timeout(PATIENCE).expect("three that do not end do not hold up the fourth");
            ends.push(end);
        }
        let (value, reported, end) = slow();
        drop_queue.push("waits", value);
        let deadline = Time::now() + PATIENCE;
        while !lock(&drop_queue.0.state).active.values().all(|drop| drop.is_logged) {
            assert!(Time::now() < deadline, "the slow drops are not logged");
            std::thread::yield_now();
        }
        assert!(reported.try_recv().is_err(), "there are no more threads than these");
        ends.pop();
        reported.recv_timeout(PATIENCE).expect("it takes the place of the one that has ended");
        drop((ends, end));
        assert!(drop_queue.wait(PATIENCE));
    }

    #[test]
    fn value_without_room_is_never_dropped() {
        let drop_queue = DropQueue::default();
        let mut ends = Vec::new();
        for _ in 0..THREADS_MAX {
            let (value, reported, end) = slow();
            drop_queue.push("slow", value);
            reported.recv_timeout(PATIENCE).expect("it has a thread");
            ends.push(end);
        }
        let counted = Arc::new(());
        for _ in 0..=WAITING_MAX {
            drop_queue.push("waits", counted.clone());
        }
        drop(ends);
        assert!(drop_queue.wait(PATIENCE));
        assert_eq!(Arc::strong_count(&counted), 2, "this one, and the one too many");
    }
}
