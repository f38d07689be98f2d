//! The open pages: each has a stream of events. While one of them looks at messages, a thread reads them, thins them
//! out and hands them to the streams. Without such a page there is no reader, and the nodes record nothing for it.

use std::{
    collections::{BTreeMap, BTreeSet},
    io,
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    thread,
    time::Duration,
};

use hyper::body::Bytes;
use sinew::Time;
use tokio::sync::mpsc::Sender;

use crate::{
    body::event,
    cache::panic_text,
    look::Look,
    scope::Scope,
    source::{Source, Tap},
};

/// Streams of all pages. A page has one.
pub(crate) const PAGES_MAX: usize = 16;
/// Time between two looks at new messages: a sixtieth of a second, as often as a screen is drawn.
const PERIOD: Duration = Duration::from_millis(16);
/// Time between two tables of the latest values.
const TABLE_PERIOD: Duration = Duration::from_millis(250);

/// An open page.
struct Page {
    scope: Scope,
    events: Sender<Bytes>,
    /// When the next table is due.
    table_due: Time,
}

#[derive(Default)]
struct State {
    pages: BTreeMap<u64, Page>,
    next: u64,
    is_over: bool,
}

/// Shared by the streams and the thread.
#[derive(Default)]
struct Shared {
    state: Mutex<State>,
    /// Notified when a page opens, and at the end.
    changed: Condvar,
}

/// The open pages. The thread ends when this is dropped.
pub(crate) struct Pages(Arc<Shared>);

/// The place of an open page, until it is dropped.
pub(crate) struct PageGuard {
    shared: Arc<Shared>,
    number: u64,
}

impl Pages {
    /// Starts the thread that reads messages while a page looks at some.
    pub(crate) fn start(source: Arc<dyn Source>) -> io::Result<Self> {
        let shared = Arc::new(Shared::default());
        let of = Arc::clone(&shared);
        thread::Builder::new().name("messages".to_owned()).spawn(move || run(&of, &*source))?;
        Ok(Self(shared))
    }

    /// Adds a page; `None` if there are as many as may be.
    pub(crate) fn open(&self, look: Look, events: Sender<Bytes>) -> Option<PageGuard> {
        let mut state = self.0.lock();
        if state.pages.len() >= PAGES_MAX {
            return None;
        }
        let number = state.next;
        state.next += 1;
        state.pages.insert(number, Page { scope: Scope::new(look), events, table_due: Time::now() });
        self.0.changed.notify_all();
        Some(PageGuard { shared: Arc::clone(&self.0), number })
    }
}

impl Drop for Pages {
    fn drop(&mut self) {
        self.0.lock().is_over = true;
        self.0.changed.notify_all();
    }
}

impl Drop for PageGuard {
    fn drop(&mut self) {
        self.shared.lock().pages.remove(&self.number);
    }
}

impl Shared {
    fn lock(&self) -> MutexGuard<'_, State> {
        self.state.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Returns the applications at which any page looks.
    fn apps(state: &State) -> BTreeSet<String> {
        state.pages.values().flat_map(|page| page.scope.look().apps.iter().cloned()).collect()
    }

    /// Waits until a page looks at messages. Returns `None` at the end.
    fn wait(&self) -> Option<BTreeSet<String>> {
        let mut state = self.lock();
        loop {
            if state.is_over {
                return None;
            }
            let apps = Self::apps(&state);
            if !apps.is_empty() {
                return Some(apps);
            }
            state = self.changed.wait(state).unwrap_or_else(PoisonError::into_inner);
        }
    }

    /// Hands the new points and, where they are due, the tables to the streams. A stream that is full gets them later.
    fn publish(&self, now: Time, offset_s: f64, faults: &[String]) {
        for page in self.lock().pages.values_mut().filter(|page| !page.scope.look().apps.is_empty()) {
            // The room comes first: points without room wait for the next time, and are counted if they are too many.
            let Ok(room) = page.events.try_reserve() else { continue };
            match page.scope.points(now, offset_s) {
                Some(points) => room.send(event("points", &points)),
                None => drop(room),
            }
            if now < page.table_due {
                continue;
            }
            let Ok(room) = page.events.try_reserve() else { continue };
            page.table_due = now + TABLE_PERIOD;
            page.scope.set_faults(faults);
            room.send(event("messages", &page.scope.table(now)));
        }
    }
}

/// Reads messages as long as a page looks at some.
fn run(shared: &Shared, source: &dyn Source) {
    let offset_s = wall_offset_s();
    while let Some(mut apps) = shared.wait() {
        let mut tap = source.tap();
        while !apps.is_empty() {
            let began = Time::now();
            let faults = poll(&mut *tap, &apps, shared);
            let is_broken = faults.is_err();
            let faults = faults.unwrap_or_else(|why| vec![why]);
            shared.publish(Time::now(), offset_s, &faults);
            if is_broken {
                // A reader that failed once is replaced, and not at once: its fault is shown meanwhile.
                thread::sleep(TABLE_PERIOD);
                break;
            }
            thread::sleep(PERIOD.saturating_sub(Time::now().since(began)));
            let state = shared.lock();
            apps = if state.is_over { BTreeSet::new() } else { Shared::apps(&state) };
        }
    }
}

fn poll(tap: &mut dyn Tap, apps: &BTreeSet<String>, shared: &Shared) -> Result<Vec<String>, String> {
    let polled = catch_unwind(AssertUnwindSafe(|| {
        tap.poll(apps, &mut |seen| {
            for page in shared.lock().pages.values_mut() {
                page.scope.take(seen);
            }
        })
    }));
    polled.map_err(|panic| {
        format!("sinew view failed while it read messages: {}; report this", panic_text(&*panic))
    })
}

/// Returns the seconds from the clock of this host's messages to its wall clock.
pub(crate) fn wall_offset_s() -> f64 {
    wall_s() - Time::now().as_nanos() as f64 / 1e9
}

/// Returns the seconds of the wall clock.
#[expect(clippy::disallowed_methods, reason = "people compare the times of a plot with a clock on the wall")]
pub(crate) fn wall_s() -> f64 {
    let since = std::time::SystemTime::now().duration_since(std::time::UNIX_EPOCH);
    // A clock before 1970 is not set.
    since.map_or(0.0, |since| since.as_secs_f64())
}

#[cfg(test)]
mod tests {
    use tokio::sync::mpsc::channel;

    use super::*;
    use crate::source::NoSystem;

    #[test]
    fn pages_have_a_bound_and_give_their_places_back() {
        let pages = Pages::start(Arc::new(NoSystem)).expect("a thread");
        let open = || pages.open(Look::default(), channel(1).0);
        let mut guards: Vec<_> = (0..PAGES_MAX).map(|_| open().expect("there is room")).collect();
        assert!(open().is_none());
        guards.pop();
        assert!(open().is_some());
    }

    #[test]
    fn page_that_looks_at_an_application_gets_its_table() {
        let pages = Pages::start(Arc::new(NoSystem)).expect("a thread");
        let (events, mut received) = channel(4);
        let look = Look::of_query("app=hip").expect("it is legal");
        let guard = pages.open(look, events).expect("there is room");
        let first = received.blocking_recv().expect("the thread lives");
        assert!(first.starts_with(b"event: messages\n"), "{first:?}");
        drop(guard);
        while received.blocking_recv().is_some() {}
    }
}
