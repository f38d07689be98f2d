//! A thread for what may take long, and what waits for it.

use std::{
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc, Mutex,
        atomic::{AtomicUsize, Ordering},
        mpsc::{Receiver, SyncSender, TrySendError, sync_channel},
    },
    thread,
    time::{Duration, Instant},
};

use crate::{nicer::give_way, stores::lock};

/// Things that may wait, at most: four for each of 64 addresses that come or go at once.
pub(super) const WAITING_MAX: usize = 256;
/// Things that one connection leaves, at most.
const LEFT_BY_ONE: usize = 4;
/// What takes longer is said.
pub(super) const SLOW: Duration = Duration::from_secs(1);

pub(super) type Task = Box<dyn FnOnce() + Send>;

/// The thread. It does what it is given in that order, and ends after that when this is dropped. A task that panics ends by itself,
/// not the thread.
pub(super) struct Worker {
    /// `None`: there is no thread.
    tasks: Option<SyncSender<Task>>,
    pub(super) queue: Arc<Queue>,
}

/// What is known of the thread.
pub(super) struct Queue {
    waiting: AtomicUsize,
    /// Since when the task at hand is done, unless that was said to be long.
    pub(super) since: Mutex<Option<Instant>>,
    /// What it may have to do in all, with what those leave who are served already.
    given_max: usize,
    name: &'static str,
    /// What it means that a task takes long.
    slow: &'static str,
}

impl Worker {
    /// Begins the thread, for what so many connections may leave at once. `slow` says what it means that one thing takes it long, `without`
    /// that there is no such thread.
    pub(super) fn begin(
        connections: usize,
        name: &'static str,
        slow: &'static str,
        without: &'static str,
    ) -> Self {
        let given_max = LEFT_BY_ONE * connections + WAITING_MAX;
        let (sender, tasks) = sync_channel(given_max);
        let (waiting, since) = (AtomicUsize::default(), Mutex::default());
        let queue = Arc::new(Queue { waiting, since, given_max, name, slow });
        let its_queue = queue.clone();
        let tasks = thread::Builder::new().name(name.to_owned()).spawn(move || work(tasks, &its_queue));
        let tasks = tasks.inspect_err(|cause| {
            let remedy = sinew_runtime::remedy::remedy(sinew_runtime::remedy::Wanted::Thread, cause);
            crate::log::warn!(%cause, %remedy, "there is no thread `{name}`: {without}");
        });
        Self { tasks: tasks.is_ok().then_some(sender), queue }
    }

    /// Whether no more waits than may. Says if that is because one thing takes long.
    pub(super) fn has_room(&self) -> bool {
        let has_room = self.tasks.is_none() || self.queue.waiting.load(Ordering::Relaxed) < WAITING_MAX;
        if !has_room {
            self.queue.say_if_slow();
        }
        has_room
    }

    /// Has `task` done, as soon as all that was given before is done.
    pub(super) fn give(&self, task: Task) {
        let Self { tasks: Some(tasks), queue } = self else { return task() };
        queue.waiting.fetch_add(1, Ordering::Relaxed);
        if let Err(TrySendError::Full(task) | TrySendError::Disconnected(task)) = tasks.try_send(task) {
            queue.waiting.fetch_sub(1, Ordering::Relaxed);
            crate::log::error!(
                "the thread `{}` has {} things to do: one is never done, and what it holds stays until the node ends",
                queue.name,
                queue.given_max
            );
            // The caller must not wait for what may take for ever.
            std::mem::forget(task);
        }
    }
}

impl Queue {
    /// Says once of the task at hand that it takes long.
    pub(super) fn say_if_slow(&self) -> bool {
        let is_slow = lock(&self.since).take_if(|since| since.elapsed() >= SLOW).is_some();
        if is_slow {
            let waiting = self.waiting.load(Ordering::Relaxed);
            let Self { name, slow, .. } = self;
            crate::log::warn!(
                waiting,
                "the thread `{name}` has been at one thing for over {SLOW:?}: a client has passed a descriptor that does not close, or the machine is short of memory; {slow}"
            );
        }
        is_slow
    }

    fn run(&self, task: Task) {
        self.waiting.fetch_sub(1, Ordering::Relaxed);
        *lock(&self.since) = Some(Instant::now());
        // Who waits for it hears that it has ended; what it held is dropped. Nothing else is shared.
        if catch_unwind(AssertUnwindSafe(task)).is_err() {
            crate::log::error!(
                "a task of the thread `{}` has panicked, which is a fault of this node's",
                self.name
            );
        }
        *lock(&self.since) = None;
    }
}

fn work(tasks: Receiver<Task>, queue: &Queue) {
    // Newcomers wait, not the messages of those who are there.
    give_way();
    tasks.into_iter().for_each(|task| queue.run(task));
}
