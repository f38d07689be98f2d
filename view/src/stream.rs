//! The stream of one page: the state of the system several times a second, events, points and tables of messages.

use std::{
    sync::{
        Arc, Mutex, PoisonError,
        atomic::{AtomicBool, Ordering},
    },
    time::Duration,
};

use hyper::body::Bytes;
use tokio::{
    sync::{
        Notify,
        mpsc::{Receiver, Sender, channel},
    },
    time::{sleep, timeout},
};

use crate::{
    answer::{Shared, stop_state},
    body::event,
    cache::PAGE_FRESH,
    events::EventLog,
    look::Look,
    model,
    pages::wall_s,
    snapshot::Snapshot,
};

/// Events that wait for a page.
const WAITING_MAX: usize = 8;
/// Time for which a page may read nothing. Then its connection is closed.
const STUCK_WITHIN: Duration = Duration::from_secs(5);

/// The part of a connection that its stream changes.
#[derive(Debug, Default)]
pub(crate) struct Line {
    is_stream: AtomicBool,
    cut: Notify,
}

impl Line {
    /// Returns whether the connection has a stream, which may last.
    pub(crate) fn is_stream(&self) -> bool {
        self.is_stream.load(Ordering::Relaxed)
    }

    /// Waits until the connection has to be closed, because its client reads nothing.
    pub(crate) async fn cut(&self) {
        self.cut.notified().await;
    }
}

/// The event of the latest snapshot. All pages share it, so that a further page costs little.
#[derive(Debug, Default)]
pub(crate) struct States(Mutex<Option<(Arc<Snapshot>, Bytes)>>);

impl States {
    /// Returns the event of a snapshot. The first call for it looks for changes, too.
    fn event(&self, snapshot: &Arc<Snapshot>, log: &mut EventLog) -> Bytes {
        let mut latest = self.0.lock().unwrap_or_else(PoisonError::into_inner);
        if let Some((of, event)) = &*latest
            && Arc::ptr_eq(of, snapshot)
        {
            return event.clone();
        }
        let wall_ms = (wall_s() * 1e3) as u64;
        log.observe(snapshot, wall_ms);
        let event = event("state", &model::state(snapshot, wall_ms));
        *latest = Some((Arc::clone(snapshot), event.clone()));
        event
    }
}

/// Opens the stream of a page; `None` if there are as many as may be.
pub(crate) fn open(shared: &Arc<Shared>, line: &Arc<Line>, look: Look) -> Option<Receiver<Bytes>> {
    let (events, received) = channel(WAITING_MAX);
    let guard = shared.pages.open(look, events.clone())?;
    line.is_stream.store(true, Ordering::Relaxed);
    let (shared, line) = (Arc::clone(shared), Arc::clone(line));
    tokio::spawn(async move {
        // A page that has gone ends it at once, also while the nodes are asked.
        let end = tokio::select! {
            end = send_states(&shared, &events) => end,
            end = send_stops(&shared, &events) => end,
            () = events.closed() => End::Closed,
        };
        drop(guard);
        if end == End::Stuck {
            line.cut.notify_one();
        }
    });
    Some(received)
}

/// How a stream ended.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum End {
    /// The page has closed it.
    Closed,
    /// The page reads nothing.
    Stuck,
}

async fn send_states(shared: &Shared, events: &Sender<Bytes>) -> End {
    let mut last = 0;
    loop {
        let Some(snapshot) = shared.cache.snapshot(PAGE_FRESH).await else { return End::Closed };
        let mut parts = vec![shared.states.event(&snapshot, &mut shared.log())];
        let new = shared.log().after(last);
        if let Some(event_last) = new.last() {
            last = event_last.number;
            parts.push(event("log", &serde_json::json!(new)));
        }
        for part in parts {
            if let Some(end) = send(events, part).await {
                return end;
            }
        }
        sleep(PAGE_FRESH).await;
    }
}

/// Sends the state of the stop, on a path of its own: a node without an answer delays the state of the system.
async fn send_stops(shared: &Arc<Shared>, events: &Sender<Bytes>) -> End {
    loop {
        let part = event("stop", &stop_state(shared).await);
        if let Some(end) = send(events, part).await {
            return end;
        }
        sleep(PAGE_FRESH).await;
    }
}

/// Sends an event to the page. Returns how the stream ended, if it did.
async fn send(events: &Sender<Bytes>, part: Bytes) -> Option<End> {
    match timeout(STUCK_WITHIN, events.send(part)).await {
        Ok(Ok(())) => None,
        Ok(Err(_)) => Some(End::Closed),
        Err(_) => Some(End::Stuck),
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::metrics::tests::{lost, snapshot};

    #[test]
    fn pages_share_the_event_of_a_snapshot() {
        let (states, mut log) = (States::default(), EventLog::default());
        let first = Arc::new(snapshot());
        let [one, other] = [0, 1].map(|_| states.event(&first, &mut log));
        assert_eq!(one.as_ptr(), other.as_ptr());
        let mut next = snapshot();
        let gone = next.nodes.pop().expect("the knee").node;
        let Ok(entry) = &mut next.entry else { panic!("it has answered") };
        entry.lost.push(lost(gone, "knee", "crashed"));
        assert_ne!(states.event(&Arc::new(next), &mut log), one);
        assert!(!log.after(0).is_empty(), "the change is an event");
    }

    #[test]
    fn page_that_reads_nothing_is_cut_off() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().start_paused(true).build();
        runtime.expect("a runtime").block_on(async {
            let shared = Shared::without_system();
            let line = Arc::new(Line::default());
            let received = open(&shared, &line, Look::default()).expect("there is room");
            line.cut().await;
            assert!(line.is_stream());
            drop(received);
        });
    }

    #[test]
    fn page_that_has_gone_gives_its_place_back() {
        let runtime = tokio::runtime::Builder::new_current_thread().enable_time().start_paused(true).build();
        runtime.expect("a runtime").block_on(async {
            let shared = Shared::without_system();
            let open = || open(&shared, &Arc::new(Line::default()), Look::default());
            let mut pages: Vec<_> = std::iter::from_fn(open).collect();
            assert!(pages.pop().is_some() && open().is_none());
            // No snapshot comes before this: only the other tasks run.
            tokio::task::yield_now().await;
            assert!(open().is_some());
        });
    }
}
