//! The thread that asks the nodes, and the latest snapshot. However many requests there are, the nodes are asked by one
//! thread, and no more often than the most impatient reader needs.

use std::{
    any::Any,
    io,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{
        Arc,
        mpsc::{Receiver, SyncSender, sync_channel},
    },
    thread,
    time::Duration,
};

use sinew::Time;
use tokio::sync::watch;

use crate::{snapshot::Snapshot, source::Source};

/// Time within which a snapshot answers a request for metrics.
pub(crate) const FRESH: Duration = Duration::from_secs(1);
/// Time between two snapshots while a page looks. It is the least time between any two.
pub(crate) const PAGE_FRESH: Duration = Duration::from_millis(330);

/// The latest snapshot.
pub(crate) struct Cache {
    /// When each order was made.
    orders: SyncSender<Time>,
    latest: watch::Receiver<Option<Arc<Snapshot>>>,
}

impl Cache {
    /// Starts the thread. It ends with the cache. Snapshots are taken at least `least` apart.
    pub(crate) fn start(source: Arc<dyn Source>, least: Duration) -> io::Result<Self> {
        let (orders, ordered) = sync_channel(1);
        let (publish, latest) = watch::channel(None);
        let work = move || answer_orders(&*source, &ordered, &publish, least);
        thread::Builder::new().name("snapshots".to_owned()).spawn(work)?;
        Ok(Self { orders, latest })
    }

    /// Returns the latest snapshot if it is no older than `fresh`, else the next one; `None` if the thread has ended.
    pub(crate) async fn snapshot(&self, fresh: Duration) -> Option<Arc<Snapshot>> {
        let mut latest = self.latest.clone();
        let known = latest.borrow_and_update().clone();
        if known.as_ref().is_some_and(|snapshot| is_fresh(snapshot, fresh)) {
            return known;
        }
        // If the queue is full, the next snapshot is ordered already.
        let _ = self.orders.try_send(Time::now());
        latest.changed().await.ok()?;
        latest.borrow().clone()
    }
}

fn is_fresh(snapshot: &Snapshot, fresh: Duration) -> bool {
    Time::now().since(snapshot.taken) < fresh
}

fn answer_orders(
    source: &dyn Source,
    orders: &Receiver<Time>,
    publish: &watch::Sender<Option<Arc<Snapshot>>>,
    least: Duration,
) {
    while let Ok(ordered) = orders.recv() {
        let last = publish.borrow().as_ref().map(|snapshot| snapshot.taken);
        // The order may have come before the begin of the last snapshot, which has answered it then.
        if last.is_some_and(|taken| taken >= ordered) {
            // A request may have come after that snapshot and found the queue full: it gets this one.
            publish.send_modify(|_| ());
            continue;
        }
        if let Some(left) = last.and_then(|taken| least.checked_sub(Time::now().since(taken))) {
            thread::sleep(left);
        }
        let _ = publish.send(Some(Arc::new(take(source))));
    }
}

/// Takes a snapshot. A panic ends that snapshot only: each one has connections of its own, so the next one is a new
/// start.
fn take(source: &dyn Source) -> Snapshot {
    catch_unwind(AssertUnwindSafe(|| source.snapshot())).unwrap_or_else(|panic| {
        let why = format!("sinew view failed while it asked the nodes: {}; report this", panic_text(&*panic));
        Snapshot::without_entry(Time::now(), why)
    })
}

/// Returns the message of a panic.
pub(crate) fn panic_text(panic: &(dyn Any + Send)) -> String {
    let text = panic.downcast_ref::<&str>().copied();
    text.or_else(|| panic.downcast_ref::<String>().map(String::as_str)).unwrap_or("a panic").to_owned()
}

#[cfg(test)]
mod tests {
    use std::sync::atomic::{AtomicUsize, Ordering};

    use sinew::{
        parameters::{ParameterOutcome, SetParameters},
        stop::StopReport,
    };

    use super::*;
    use crate::{
        source::{AppParameters, Live, NoSystem, Tap},
        stop::StopAct,
    };

    const HOUR: Duration = Duration::from_secs(3_600);

    /// Counts the snapshots, and panics in the first `panics` of them.
    struct Counted {
        asked: Arc<AtomicUsize>,
        panics: usize,
    }

    impl Source for Counted {
        fn snapshot(&self) -> Snapshot {
            assert!(self.asked.fetch_add(1, Ordering::Relaxed) >= self.panics, "planted");
            Snapshot::without_entry(Time::now(), "it is a test".to_owned())
        }

        fn parameters(&self) -> Result<Vec<AppParameters>, String> {
            NoSystem.parameters()
        }

        fn set(&self, app: &str, set: &SetParameters) -> Result<ParameterOutcome, String> {
            NoSystem.set(app, set)
        }

        fn stop(&self, act: StopAct) -> Result<StopReport, String> {
            NoSystem.stop(act)
        }

        fn tap(&self) -> Box<dyn Tap> {
            NoSystem.tap()
        }

        fn live(&self) -> Box<dyn Live> {
            NoSystem.live()
        }
    }

    fn cache(panics: usize) -> (Cache, Arc<AtomicUsize>) {
        let asked = Arc::new(AtomicUsize::new(0));
        let source = Arc::new(Counted { asked: Arc::clone(&asked), panics });
        (Cache::start(source, Duration::ZERO).expect("a thread"), asked)
    }

    fn runtime() -> tokio::runtime::Runtime {
        tokio::runtime::Builder::new_current_thread().build().expect("a runtime")
    }

    fn asked_for_two(fresh: Duration) -> usize {
        let (cache, asked) = cache(0);
        for _ in 0..2 {
            assert!(runtime().block_on(cache.snapshot(fresh)).is_some());
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
        let (cache, asked) = cache(0);
        let (one, other) =
            runtime().block_on(async { tokio::join!(cache.snapshot(HOUR), cache.snapshot(HOUR)) });
        assert!(one.is_some() && other.is_some());
        // The thread may have begun between the two.
        let shared = asked.load(Ordering::Relaxed);
        assert!(shared <= 2, "{shared}");
        assert!(runtime().block_on(cache.snapshot(HOUR)).is_some());
        assert_eq!(asked.load(Ordering::Relaxed), shared);
    }

    #[test]
    fn snapshot_after_a_panic_is_a_new_start() {
        let (cache, _) = cache(1);
        let next = || runtime().block_on(cache.snapshot(Duration::ZERO)).expect("the thread lives");
        let why = next().entry.clone().expect_err("the source has panicked");
        assert!(why.contains("planted"), "{why}");
        assert_eq!(next().entry.clone(), Err("it is a test".to_owned()));
    }
}
