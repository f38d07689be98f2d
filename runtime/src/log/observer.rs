//! Observers of the runtime's log: they receive each event on the log thread, beside its reader.

use std::sync::{Arc, Mutex, Weak};

use tracing::Level;

use crate::lock;

/// Maximum number of observers in a process: each node of it has one, and one more while it records.
const OBSERVERS_MAX: usize = 128;

/// An observer of log events. It is called on the log thread, and delays later lines as long as it runs.
pub trait LogObserver: Send + Sync {
    /// Receives an event: its level, its target, and its message with its fields.
    fn wrote(&self, level: Level, target: &str, text: &str);
}

static OBSERVERS: Mutex<Vec<Weak<dyn LogObserver>>> = Mutex::new(Vec::new());

/// Adds an observer, for as long as it lives. Returns `false` if there are too many.
pub fn observe(observer: &Arc<dyn LogObserver>) -> bool {
    let mut observers = lock(&OBSERVERS);
    observers.retain(|other| other.strong_count() > 0);
    let has_room = observers.len() < OBSERVERS_MAX;
    if has_room {
        observers.push(Arc::downgrade(observer));
    }
    has_room
}

/// Shows an event to all observers. Its text is made only if there is one.
pub(crate) fn show(level: Level, target: &str, text: impl FnOnce() -> String) {
    // The lock is released before any of them is called.
    let observers: Vec<_> = lock(&OBSERVERS).iter().filter_map(Weak::upgrade).collect();
    if observers.is_empty() {
        return;
    }
    let text = text();
    observers.iter().for_each(|observer| observer.wrote(level, target, &text));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Default)]
    struct Notes(Mutex<Vec<String>>);

    impl LogObserver for Notes {
        fn wrote(&self, level: Level, target: &str, text: &str) {
            // Other tests of this process log, too.
            if target == "sinew::test_of_observers" {
                lock(&self.0).push(format!("{level} {text}"));
            }
        }
    }

    #[test]
    fn observer_receives_events_until_it_is_dropped() {
        let notes = Arc::new(Notes::default());
        let observer: Arc<dyn LogObserver> = notes.clone();
        assert!(observe(&observer));
        crate::log::error!(target: "sinew::test_of_observers", number = 7, "it broke");
        crate::log::flush(std::time::Duration::from_secs(10));
        assert_eq!(*lock(&notes.0), ["ERROR it broke number=7"]);
        let weak = Arc::downgrade(&notes);
        drop((observer, notes));
        crate::log::error!(target: "sinew::test_of_observers", "nobody sees it");
        crate::log::flush(std::time::Duration::from_secs(10));
        assert_eq!(weak.strong_count(), 0);
    }
}
