//! Where values of the user's are dropped that nobody needs any more: on threads of their own, never on the root's.
//!
//! A factory and what it captured are foreign code, what a panic carried too, and so is their drop: it may last, never end,
//! or panic. Whoever supervises others must not wait for it.

use std::{
    any::Any,
    collections::{BTreeMap, VecDeque},
    panic::{AssertUnwindSafe, catch_unwind},
    sync::{Arc, Condvar, Mutex, PoisonError},
    time::Duration,
};

use super::{
    panics::{is_the_runtimes, words},
    place::make_ordinary,
};
use crate::{log, post::lock, time::Time};

/// Drops at one time at most: so many that never end hold up nobody.
const THREADS_MAX: usize = 4;
/// Values that wait at most. One more is never dropped, and that is said.
const WAITING_MAX: usize = 4_096;
/// Time after which a drop is said to last.
const LONG: Duration = Duration::from_secs(1);

/// Drops what it is given, later and elsewhere. Clones are the same place.
#[derive(Clone, Default)]
pub struct Burials(Arc<Shared>);

#[derive(Default)]
struct Shared {
    state: Mutex<State>,
    /// A drop has ended, or one more is there to be watched.
    changed: Condvar,
}

#[derive(Default)]
struct State {
    waiting: VecDeque<Remains>,
    under_way: BTreeMap<u64, UnderWay>,
    count: u64,
    threads: usize,
    is_watched: bool,
}

struct Remains {
    whose: String,
    what: Box<dyn Any + Send>,
}

/// A drop that has begun.
struct UnderWay {
    whose: String,
    since: Time,
    was_said: bool,
}

impl std::fmt::Debug for Burials {
    fn fmt(&self, f: &mut std::fmt::Formatter<'_>) -> std::fmt::Result {
        let state = lock(&self.0.state);
        write!(f, "Burials({} under way, {} waiting)", state.under_way.len(), state.waiting.len())
    }
}

impl Burials {
    /// Drops `what`, which is `whose`, on a thread called `burial`. Returns at once. Its panic is caught; if it lasts, that
    /// is said, and it holds up others only if there are four of the kind.
    pub fn bury(&self, whose: impl Into<String>, what: impl Any + Send) {
        let remains = Remains { whose: whose.into(), what: Box::new(what) };
        let mut state = lock(&self.0.state);
        if state.waiting.len() >= WAITING_MAX {
            let whose = remains.whose;
            std::mem::forget(remains.what);
            return log::error!(whose, WAITING_MAX, "so many wait to be dropped; this one never is");
        }
        state.waiting.push_back(remains);
        if state.threads < THREADS_MAX && self.begin("burial", Self::work) {
            state.threads += 1;
        }
        if !state.is_watched {
            state.is_watched = self.begin("burial-watch", Self::watch);
        }
    }

    /// Waits until all that was given is dropped, for so long at most. Returns whether it is.
    pub fn wait(&self, within: Duration) -> bool {
        let state = lock(&self.0.state);
        let waited = self.0.changed.wait_timeout_while(state, within, |state| !state.is_idle());
        let (state, _) = waited.unwrap_or_else(PoisonError::into_inner);
        state.is_idle()
    }

    fn begin(&self, name: &str, work: fn(&Self)) -> bool {
        let burials = self.clone();
        let begun = std::thread::Builder::new().name(name.to_owned()).spawn(move || {
            is_the_runtimes();
            // Whose panic it was may have a real-time priority.
            make_ordinary();
            work(&burials);
        });
        if let Err(error) = &begun {
            // What waits is dropped after the next one.
            let remedy = crate::remedy::remedy(crate::remedy::Wanted::Thread, error);
            log::error!(%error, name, %remedy, "there is no thread to drop what is over");
        }
        begun.is_ok()
    }

    /// Drops one after the other until none waits.
    fn work(&self) {
        while let Some((number, remains)) = self.next() {
            let Remains { whose, what } = remains;
            if let Err(panic) = catch_unwind(AssertUnwindSafe(|| drop(what))) {
                log::error!(whose, said = words(panic), "what it left behind panicked while it was dropped");
            }
            lock(&self.0.state).under_way.remove(&number);
            self.0.changed.notify_all();
        }
    }

    /// Takes the next one. `None`: there is none, and this thread is counted no more.
    fn next(&self) -> Option<(u64, Remains)> {
        let mut state = lock(&self.0.state);
        let Some(remains) = state.waiting.pop_front() else {
            state.threads -= 1;
            drop(state);
            self.0.changed.notify_all();
            return None;
        };
        state.count += 1;
        let number = state.count;
        let under_way = UnderWay { whose: remains.whose.clone(), since: Time::now(), was_said: false };
        state.under_way.insert(number, under_way);
        Some((number, remains))
    }

    /// Says who lasts, until nothing is under way. Runs nobody's code, so that it can.
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
            for (whose, lasts) in late {
                log::error!(whose, ?lasts, waiting, "what it left behind has not come back from its drop");
            }
        }
        state.is_watched = false;
    }
}

impl State {
    fn is_busy(&self) -> bool {
        self.threads > 0 || !self.under_way.is_empty()
    }

    fn is_idle(&self) -> bool {
        !self.is_busy() && self.waiting.is_empty()
    }

    /// Those that last and were not said to.
    fn take_late(&mut self, now: Time) -> Vec<(String, Duration)> {
        let late = self.under_way.values_mut().filter(|one| !one.was_said && now.since(one.since) >= LONG);
        let say = |one: &mut UnderWay| {
            one.was_said = true;
            (one.whose.clone(), now.since(one.since))
        };
        late.map(say).collect()
    }
}

#[cfg(test)]
mod tests {
    use std::sync::mpsc::{Receiver, SyncSender, sync_channel};

    use super::*;

    const PATIENCE: Duration = Duration::from_secs(20);

    /// Says where it is dropped, and is then dropped until it is told to end.
    struct Slow {
        said: SyncSender<Option<String>>,
        until: Receiver<()>,
    }

    impl Drop for Slow {
        fn drop(&mut self) {
            self.said.send(std::thread::current().name().map(str::to_owned)).expect("it is waited for");
            // Whoever lets it end may have dropped the other end.
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
        let ((said, heard), (end, until)) = (sync_channel(1), sync_channel(1));
        (Slow { said, until }, heard, end)
    }

    #[test]
    fn a_value_is_dropped_on_a_thread_that_says_so_and_its_panic_is_caught() {
        let burials = Burials::default();
        burials.bury("panics", Panics);
        let (value, heard, end) = slow();
        burials.bury("slow", value);
        assert_eq!(heard.recv_timeout(PATIENCE).expect("it is dropped").as_deref(), Some("burial"));
        assert!(!burials.wait(Duration::from_millis(1)), "it is not dropped yet");
        end.send(()).expect("it waits for this");
        assert!(burials.wait(PATIENCE));
    }

    #[test]
    fn as_many_drops_that_never_end_as_there_are_threads_are_said_and_what_waits_goes_on_when_one_ends() {
        let burials = Burials::default();
        let mut ends = Vec::new();
        for _ in 0..THREADS_MAX {
            let (value, heard, end) = slow();
            burials.bury("slow", value);
            heard.recv_timeout(PATIENCE).expect("three that do not end do not hold up the fourth");
            ends.push(end);
        }
        let (value, heard, end) = slow();
        burials.bury("waits", value);
        let deadline = Time::now() + PATIENCE;
        while !lock(&burials.0.state).under_way.values().all(|one| one.was_said) {
            assert!(Time::now() < deadline, "nobody says that they last");
            std::thread::yield_now();
        }
        assert!(heard.try_recv().is_err(), "there are no more threads than these");
        ends.pop();
        heard.recv_timeout(PATIENCE).expect("it takes the place of the one that has ended");
        drop((ends, end));
        assert!(burials.wait(PATIENCE));
    }

    #[test]
    fn what_nobody_has_room_for_is_never_dropped() {
        let burials = Burials::default();
        let mut ends = Vec::new();
        for _ in 0..THREADS_MAX {
            let (value, heard, end) = slow();
            burials.bury("slow", value);
            heard.recv_timeout(PATIENCE).expect("it has a thread");
            ends.push(end);
        }
        let counted = Arc::new(());
        for _ in 0..=WAITING_MAX {
            burials.bury("waits", counted.clone());
        }
        drop(ends);
        assert!(burials.wait(PATIENCE));
        assert_eq!(Arc::strong_count(&counted), 2, "this one, and the one too many");
    }
}
