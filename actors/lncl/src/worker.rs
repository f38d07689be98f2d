//! A worker thread for tasks that may take long, and its bounded queue.

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

use sinew_model::thread_priority::lower_priority;
use sinew_runtime::lock;

/// Maximum number of waiting tasks: four for each of 64 addresses that connect or disconnect at once.
pub(super) const WAITING_MAX: usize = 256;
/// Maximum number of tasks that one connection leaves behind.
const LEFT_BY_ONE: usize = 4;
/// A task that takes longer than this is logged.
pub(super) const SLOW: Duration = Duration::from_secs(1);

pub(super) type Task = Box<dyn FnOnce() + Send>;

/// The worker thread. It runs its tasks in order, and ends after the last one when this is dropped. A task that panics
/// does not end the thread.
pub(super) struct Worker {
    /// `None` if the thread could not be started.
    tasks: Option<SyncSender<Task>>,
    pub(super) queue: Arc<Queue>,
}

/// State that the thread shares with its callers.
pub(super) struct Queue {
    waiting: AtomicUsize,
    /// Start of the current task. `None` if there is none, or if it was already logged as slow.
    pub(super) since: Mutex<Option<Instant>>,
    /// Maximum number of tasks in the queue, including those that served connections leave behind.
    tasks_max: usize,
    name: &'static str,
    /// Consequence of a slow task, for the log.
    slow: &'static str,
}

impl Worker {
    /// Starts the thread, with a queue for the tasks of `connections` connections. `slow` is the consequence of a slow
    /// task, and `without` the consequence of a failed start; both are logged.
    pub(super) fn begin(
        connections: usize,
        name: &'static str,
        slow: &'static str,
        without: &'static str,
    ) -> Self {
        let tasks_max = LEFT_BY_ONE * connections + WAITING_MAX;
        let (sender, tasks) = sync_channel(tasks_max);
        let (waiting, since) = (AtomicUsize::default(), Mutex::default());
        let queue = Arc::new(Queue { waiting, since, tasks_max, name, slow });
        let its_queue = queue.clone();
        let tasks = thread::Builder::new().name(name.to_owned()).spawn(move || work(tasks, &its_queue));
        let tasks = tasks.inspect_err(|cause| {
            let remedy = sinew_runtime::remedy::remedy(sinew_runtime::remedy::Wanted::Thread, cause);
            sinew_runtime::log::warn!(%cause, %remedy, "there is no thread `{name}`: {without}");
        });
        Self { tasks: tasks.is_ok().then_some(sender), queue }
    }

    /// Returns whether the queue is below [`WAITING_MAX`]. Logs a warning if it is not and the current task is slow.
    pub(super) fn has_room(&self) -> bool {
        let has_room = self.tasks.is_none() || self.queue.waiting.load(Ordering::Relaxed) < WAITING_MAX;
        if !has_room {
            self.queue.log_if_slow();
        }
        has_room
    }

    /// Queues `task` behind all earlier tasks. Without a thread, runs it here.
    pub(super) fn submit(&self, task: Task) {
        let Self { tasks: Some(tasks), queue } = self else { return task() };
        queue.waiting.fetch_add(1, Ordering::Relaxed);
        if let Err(TrySendError::Full(task) | TrySendError::Disconnected(task)) = tasks.try_send(task) {
            queue.waiting.fetch_sub(1, Ordering::Relaxed);
            sinew_runtime::log::error!(
                "the thread `{}` has {} things to do: one is never done, and what it holds stays until the node ends",
                queue.name,
                queue.tasks_max
            );
            // Dropping the task here could block the caller forever.
            std::mem::forget(task);
        }
    }
}

impl Queue {
    /// Logs once that the current task is slow. Returns whether it logged.
    pub(super) fn log_if_slow(&self) -> bool {
        let is_slow = lock(&self.since).take_if(|since| since.elapsed() >= SLOW).is_some();
        if is_slow {
            let waiting = self.waiting.load(Ordering::Relaxed);
            let Self { name, slow, .. } = self;
            sinew_runtime::log::warn!(
                waiting,
                "the thread `{name}` has been at one thing for over {SLOW:?}: a client has passed a descriptor that does not close, or the machine is short of memory; {slow}"
            );
        }
        is_slow
    }

    fn run(&self, task: Task) {
        self.waiting.fetch_sub(1, Ordering::Relaxed);
        *lock(&self.since) = Some(Instant::now());
        // A waiter for the task learns of its end, since the unwind drops all that the task held. Nothing else is
        // shared.
        if catch_unwind(AssertUnwindSafe(task)).is_err() {
            sinew_runtime::log::error!(
                "a task of the thread `{}` has panicked, which is a fault of this node's",
                self.name
            );
        }
        *lock(&self.since) = None;
    }
}

fn work(tasks: Receiver<Task>, queue: &Queue) {
    // New connections may wait; messages of connected clients may not.
    lower_priority();
    tasks.into_iter().for_each(|task| queue.run(task));
}
