//! The tasks of a link: one reads and delivers, one writes queued messages. They are not part of the actor,
//! which is notified only of required events. A message therefore costs the turn of one task, however many
//! links there are.

use std::{panic, sync::Arc, thread};

use sinew_runtime::{safe_wake::SafelyWoken, time::Time};
use tokio::{runtime::Handle, sync::mpsc, task};
use tokio_util::task::AbortOnDropHandle;

use super::{
    link::{EventKind, Reader},
    transport::Transport,
    yield_policy::YieldPolicy,
};

/// Maximum number of a link's events that wait for the shell. While there are as many, nothing is read.
const EVENTS_MAX: usize = 8;

/// The thread of a link's tasks.
#[derive(Clone)]
pub(super) enum TaskThread {
    /// On the calling thread, which is the IO thread.
    Io,
    /// Another thread, which yields to others.
    Other(Handle, Arc<YieldPolicy>),
}

impl TaskThread {
    pub(super) const fn is_io(&self) -> bool {
        matches!(self, Self::Io)
    }

    /// Ends the turn of a task, and yields to other threads. The caller holds no lock.
    ///
    /// The IO thread's turns are short enough. A Bulk task may always have its next turn ready, and would run
    /// for as long as the scheduler allows. This is a millisecond and more, even if another thread was woken
    /// for Control and waits for this CPU. See [`YieldPolicy`].
    pub(super) fn end_turn(&self) {
        match self {
            Self::Io => {}
            Self::Other(_, policy) => {
                let now = Time::now();
                if policy.should_yield(now) {
                    thread::yield_now();
                    policy.resumed(now, Time::now());
                }
            }
        }
    }

    /// Starts a task, which ends when its handle is dropped.
    pub(super) fn begin<T: Send + 'static>(
        &self,
        task: impl Future<Output = T> + Send + 'static,
    ) -> AbortOnDropHandle<T> {
        AbortOnDropHandle::new(match self {
            Self::Io => task::spawn_local(SafelyWoken::new(task)),
            Self::Other(runtime, _) => runtime.spawn(task),
        })
    }
}

/// Waits for the result of a task.
pub(super) async fn end_of<T>(task: AbortOnDropHandle<T>) -> Option<T> {
    match task.await {
        Ok(end) => Some(end),
        // The waiting code is the layer: it fails with the task, and is restarted.
        Err(error) if error.is_panic() => panic::resume_unwind(error.into_panic()),
        Err(_) => None,
    }
}

/// The thread on which a connection continues when it has become a link.
pub(super) struct Relocation {
    pub(super) thread: TaskThread,
    /// The same connection, for the tasks of that thread.
    pub(super) transport: Transport,
}

/// The reading task of a link, as its shell sees it.
pub(super) struct ReadingTask {
    events: mpsc::Receiver<EventKind>,
    task: AbortOnDropHandle<()>,
}

impl ReadingTask {
    pub(super) fn begin(reader: Reader, thread: &TaskThread) -> Self {
        let (sender, events) = mpsc::channel(EVENTS_MAX);
        Self { events, task: thread.begin(read(reader, sender)) }
    }

    /// Returns the next event for the shell, and the task; `None` when the connection has ended.
    pub(super) async fn next(mut self) -> Option<(EventKind, Self)> {
        match self.events.recv().await {
            Some(event) => Some((event, self)),
            None => {
                end_of(self.task).await;
                None
            }
        }
    }
}

async fn read(mut reader: Reader, sender: mpsc::Sender<EventKind>) {
    while let Some(event) = reader.next().await {
        if sender.send(event).await.is_err() {
            return;
        }
    }
}
