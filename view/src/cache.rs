//! The thread that asks the nodes, and the latest snapshot. However many requests there are, the nodes are asked at
//! most once in [`FRESH`], and by one thread.

use std::{
    io,
    sync::{
        Arc,
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    thread,
    time::Duration,
};

use sinew::Time;
use tokio::sync::watch;

use crate::snapshot::Snapshot;

/// Time within which a snapshot answers all requests.
pub(crate) const FRESH: Duration = Duration::from_secs(1);

/// Asks all nodes. Each call has a time limit, below that of a request.
pub trait Source: Send + 'static {
    /// Returns the state of the system. Nodes without an answer are part of it.
    fn snapshot(&mut self) -> Snapshot;
}

/// The latest snapshot.
pub(crate) struct Cache {
    orders: SyncSender<()>,
    latest: watch::Receiver<Option<Arc<Snapshot>>>,
    fresh: Duration,
}

impl Cache {
    /// Starts the thread. It ends with the cache.
    pub(crate) fn start(source: impl Source, fresh: Duration) -> io::Result<Self> {
        let (orders, ordered) = sync_channel(1);
        let (publish, latest) = watch::channel(None);
        let work = move || answer_orders(source, &ordered, &publish, fresh);
        thread::Builder::new().name("snapshots".to_owned()).spawn(work)?;
        Ok(Self { orders, latest, fresh })
    }

    /// Returns the latest snapshot if it is fresh, else the next one; `None` if the thread has ended.
    pub(crate) async fn snapshot(&self) -> Option<Arc<Snapshot>> {
        let mut latest = self.latest.clone();
        let known = latest.borrow_and_update().clone();
        if known.as_ref().is_some_and(|snapshot| is_fresh(snapshot, self.fresh)) {
            return known;
        }
        // If the queue is full, the next snapshot is ordered already.
        let _ = self.orders.try_send(());
        latest.changed().await.ok()?;
        latest.borrow().clone()
    }
}

fn is_fresh(snapshot: &Snapshot, fresh: Duration) -> bool {
    Time::now().since(snapshot.taken) < fresh
}

fn answer_orders(
    mut source: impl Source,
    ordered: &Receiver<()>,
    publish: &watch::Sender<Option<Arc<Snapshot>>>,
    fresh: Duration,
) {
    while ordered.recv().is_ok() {
        // The order may have come before the end of the last snapshot, which has answered it then.
        let is_answered = publish.borrow().as_ref().is_some_and(|snapshot| is_fresh(snapshot, fresh));
        if !is_answered {
            let _ = publish.send(Some(Arc::new(source.snapshot())));
        }
    }
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use super::*;

    const HOUR: Duration = Duration::from_secs(3_600);

    struct Counted(Arc<AtomicUsize>);

    impl Source for Counted {
        fn snapshot(&mut self) -> Snapshot {
            self.0.fetch_add(1, Ordering::Relaxed);
            Snapshot::without_entry(Time::now(), "it is a test".to_owned())
        }
    }

    struct Broken;

    impl Source for Broken {
        fn snapshot(&mut self) -> Snapshot {
            panic!("planted");
        }
    }

    fn asked_for_two(fresh: Duration) -> usize {
        let asked = Arc::new(AtomicUsize::new(0));
        let cache = Cache::start(Counted(Arc::clone(&asked)), fresh).expect("a thread");
        let runtime = tokio::runtime::Builder::new_current_thread().build().expect("a runtime");
        for _ in 0..2 {
            assert!(runtime.block_on(cache.snapshot()).is_some());
        }
        asked.load(Ordering::Relaxed)
    }

    #[test]
    fn fresh_snapshot_answers_all_requests() {
        assert_eq!(asked_for_two(HOUR), 1);
        assert_eq!(asked_for_two(Duration::ZERO), 2);
    }

    #[test]
    fn requests_at_the_same_time_share_a_snapshot() {
        let asked = Arc::new(AtomicUsize::new(0));
        let cache = Cache::start(Counted(Arc::clone(&asked)), HOUR).expect("a thread");
        let runtime = tokio::runtime::Builder::new_current_thread().build().expect("a runtime");
        let (one, other) = runtime.block_on(async { tokio::join!(cache.snapshot(), cache.snapshot()) });
        assert!(one.is_some() && other.is_some());
        assert_eq!(asked.load(Ordering::Relaxed), 1);
    }

    #[test]
    fn request_ends_although_the_source_panics() {
        let cache = Cache::start(Broken, HOUR).expect("a thread");
        let runtime = tokio::runtime::Builder::new_current_thread().build().expect("a runtime");
        assert!(runtime.block_on(cache.snapshot()).is_none());
    }
}
