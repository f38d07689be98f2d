//! Incidents of this process: a guard that was shut, a missed deadline, a failed actor. Nodes that record observe them,
//! and freeze the messages around them.

use std::{
    fmt,
    sync::{
        Arc, Mutex, TryLockError, Weak,
        atomic::{AtomicUsize, Ordering},
    },
};

use crate::{lock, time::Time};

/// Maximum number of observers in a process: each node of it that records is one.
const OBSERVERS_MAX: usize = 64;

/// The kind of an incident.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum IncidentKind {
    /// An actor has failed, or an output cannot be made safe. That is a fault at any time.
    Failure,
    /// A guard is shut, an input is late, or an application asks. While a node stops in order, these follow from that.
    Symptom,
}

/// An observer of incidents. It is called on the thread of the incident, which may be a real-time thread, so it must
/// not wait.
pub trait IncidentObserver: Send + Sync {
    /// Receives an incident.
    fn happened(&self, at: Time, kind: IncidentKind, cause: &str);
}

static OBSERVERS: Mutex<Vec<Weak<dyn IncidentObserver>>> = Mutex::new(Vec::new());
/// Number of observers, some of which may have been dropped. Without any an incident costs one load.
static COUNT: AtomicUsize = AtomicUsize::new(0);

/// Adds an observer, for as long as it lives. Returns `false` if there are too many.
pub fn observe(observer: &Arc<dyn IncidentObserver>) -> bool {
    let mut observers = lock(&OBSERVERS);
    observers.retain(|other| other.strong_count() > 0);
    let has_room = observers.len() < OBSERVERS_MAX;
    if has_room {
        observers.push(Arc::downgrade(observer));
    }
    // SYNC: Relaxed: an incident at this moment may be missed.
    COUNT.store(observers.len(), Ordering::Relaxed);
    has_room
}

/// Reports an incident to all observers. It never waits: an incident that meets another one, or the begin of a
/// recording, is not reported. The other one is a trigger for the same span.
pub fn report(at: Time, kind: IncidentKind, cause: fmt::Arguments<'_>) {
    if COUNT.load(Ordering::Relaxed) == 0 {
        return;
    }
    let observers: Vec<_> = match OBSERVERS.try_lock() {
        Ok(observers) => observers.iter().filter_map(Weak::upgrade).collect(),
        Err(TryLockError::Poisoned(poisoned)) => {
            poisoned.into_inner().iter().filter_map(Weak::upgrade).collect()
        }
        Err(TryLockError::WouldBlock) => return,
    };
    if observers.is_empty() {
        return;
    }
    let cause = cause.to_string();
    observers.iter().for_each(|observer| observer.happened(at, kind, &cause));
}

#[cfg(test)]
mod tests {
    use super::*;

    #[derive(Default)]
    struct Notes(Mutex<Vec<(Time, String)>>);

    impl IncidentObserver for Notes {
        fn happened(&self, at: Time, kind: IncidentKind, cause: &str) {
            // Other tests of this process have incidents, too.
            if kind == IncidentKind::Failure && cause.starts_with("test of incidents") {
                lock(&self.0).push((at, cause.to_owned()));
            }
        }
    }

    #[test]
    fn observer_receives_incidents_until_it_is_dropped() {
        let notes = Arc::new(Notes::default());
        let observer: Arc<dyn IncidentObserver> = notes.clone();
        assert!(observe(&observer));
        let at = Time::from_nanos(7);
        // Another test's incident may be reported at the same moment.
        while lock(&notes.0).is_empty() {
            report(at, IncidentKind::Failure, format_args!("test of incidents {}", 1));
        }
        assert_eq!(lock(&notes.0)[0], (at, "test of incidents 1".to_owned()));
        let weak = Arc::downgrade(&notes);
        drop((observer, notes));
        report(at, IncidentKind::Failure, format_args!("test of incidents 2"));
        assert_eq!(weak.strong_count(), 0);
    }
}
