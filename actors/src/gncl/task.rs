//! The tasks of a link: one reads and delivers, one writes what waits. They are no part of the actor, which hears of them only what
//! it must know: a message costs the turn of one task, however many links there are.

use std::{panic, sync::Arc, thread};

use sinew_runtime::{safe_wake::SafelyWoken, time::Time};
use tokio::{runtime::Handle, sync::mpsc, task};
use tokio_util::task::AbortOnDropHandle;

use super::{
    courtesy::Courtesy,
    link::{Reader, What},
    transport::Transport,
};

/// News of a link that wait for the shell at most. While there are so many, nothing is read.
const NEWS_MAX: usize = 8;

/// Where a link's tasks are.
#[derive(Clone)]
pub(super) enum Place {
    /// On the calling thread, which is the IO thread.
    Here,
    /// On another one, which gives way to others.
    There(Handle, Arc<Courtesy>),
}

impl Place {
    pub(super) const fn is_here(&self) -> bool {
        matches!(self, Self::Here)
    }

    /// A task has had its turn, and goes on if nobody else wants to: with no lock in hand.
    ///
    /// The IO thread's turns are short enough. One of Bulk may have the next one ready for as long as the system lets it run, which is a
    /// millisecond and more even where somebody has been woken for Control and waits for this CPU. See [`Courtesy`].
    pub(super) fn end_turn(&self) {
        match self {
            Self::Here => {}
            Self::There(_, courtesy) => {
                let now = Time::now();
                if courtesy.gives_way(now) {
                    thread::yield_now();
                    courtesy.was_away(now, Time::now());
                }
            }
        }
    }

    /// Begins a task, which ends when its handle is dropped.
    pub(super) fn begin<T: Send + 'static>(
        &self,
        task: impl Future<Output = T> + Send + 'static,
    ) -> AbortOnDropHandle<T> {
        AbortOnDropHandle::new(match self {
            Self::Here => task::spawn_local(SafelyWoken::new(task)),
            Self::There(runtime, _) => runtime.spawn(task),
        })
    }
}

/// What a task came to.
pub(super) async fn end_of<T>(task: AbortOnDropHandle<T>) -> Option<T> {
    match task.await {
        Ok(end) => Some(end),
        // Whoever waits is the layer: it has failed, and is made anew.
        Err(error) if error.is_panic() => panic::resume_unwind(error.into_panic()),
        Err(_) => None,
    }
}

/// Where a connection goes on when it has become a link.
pub(super) struct Move {
    pub(super) place: Place,
    /// The same connection, for the tasks of that place.
    pub(super) transport: Transport,
}

/// The reading task of a link, as its shell sees it.
pub(super) struct ReadingTask {
    news: mpsc::Receiver<What>,
    task: AbortOnDropHandle<()>,
}

impl ReadingTask {
    pub(super) fn begin(reader: Reader, place: &Place) -> Self {
        let (say, news) = mpsc::channel(NEWS_MAX);
        Self { news, task: place.begin(read(reader, say)) }
    }

    /// What the shell must know next, and who says more; `None` when the connection has ended.
    pub(super) async fn next(mut self) -> Option<(What, Self)> {
        match self.news.recv().await {
            Some(what) => Some((what, self)),
            None => {
                end_of(self.task).await;
                None
            }
        }
    }
}

async fn read(mut reader: Reader, say: mpsc::Sender<What>) {
    while let Some(what) = reader.next().await {
        if say.send(what).await.is_err() {
            return;
        }
    }
}
