//! The observations of a scenario, in order: actors on any thread write them, the test waits for them.

use std::{
    fmt::Debug,
    sync::{Arc, Condvar, Mutex, MutexGuard, PoisonError},
    time::Instant,
};

use crate::DEADLINE;

/// Maximum number of entries. A scenario that writes more is broken, and panics.
const ENTRIES_MAX: usize = 1_000_000;

/// A log of `E`. Clones share the same entries.
#[derive(Debug)]
pub struct Log<E>(Arc<(Mutex<Vec<E>>, Condvar)>);

impl<E> Clone for Log<E> {
    fn clone(&self) -> Self {
        Self(self.0.clone())
    }
}

impl<E> Default for Log<E> {
    fn default() -> Self {
        Self(Arc::default())
    }
}

impl<E: Clone + Debug> Log<E> {
    fn entries(&self) -> MutexGuard<'_, Vec<E>> {
        self.0.0.lock().unwrap_or_else(PoisonError::into_inner)
    }

    /// Adds an entry.
    ///
    /// # Panics
    /// If the log is full.
    pub fn write(&self, entry: E) {
        let mut entries = self.entries();
        assert!(entries.len() < ENTRIES_MAX, "a scenario writes without end");
        entries.push(entry);
        drop(entries);
        self.0.1.notify_all();
    }

    /// All entries so far.
    #[must_use]
    pub fn all(&self) -> Vec<E> {
        self.entries().clone()
    }

    /// Waits until `find` returns a value for the whole log.
    ///
    /// # Panics
    /// If it does not in time. The message contains `what` and the entries.
    #[track_caller]
    pub fn wait<T>(&self, what: &str, mut find: impl FnMut(&[E]) -> Option<T>) -> T {
        let until = Instant::now() + DEADLINE;
        let mut entries = self.entries();
        loop {
            if let Some(found) = find(&entries) {
                return found;
            }
            let left = until.saturating_duration_since(Instant::now());
            assert!(!left.is_zero(), "{what} did not come within {DEADLINE:?}; what came: {entries:?}");
            entries = self.0.1.wait_timeout(entries, left).unwrap_or_else(PoisonError::into_inner).0;
        }
    }
}

impl<E: Clone + Debug + PartialEq> Log<E> {
    /// Waits for this entry, at any position.
    #[track_caller]
    pub fn wait_for(&self, entry: E) {
        self.wait(&format!("{entry:?}"), |entries| entries.contains(&entry).then_some(()));
    }

    /// Waits until the log contains this entry `count` times.
    #[track_caller]
    pub fn wait_for_many(&self, entry: E, count: usize) {
        let is_there = |entries: &[E]| entries.iter().filter(|one| **one == entry).count() >= count;
        self.wait(&format!("{entry:?} for the {count}. time"), |entries| is_there(entries).then_some(()));
    }
}

/// Polls until `is_so` returns a value, for states without a notification.
///
/// # Panics
/// If it does not in time.
#[track_caller]
pub fn until<T>(what: &str, mut is_so: impl FnMut() -> Option<T>) -> T {
    let end = Instant::now() + DEADLINE;
    loop {
        if let Some(found) = is_so() {
            return found;
        }
        assert!(Instant::now() < end, "{what} did not come true within {DEADLINE:?}");
        // The polling interval; no event depends on it.
        std::thread::sleep(std::time::Duration::from_millis(1));
    }
}
