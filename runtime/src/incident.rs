//! Incidents of this process: a guard that was shut, a missed deadline, a failed actor. Nodes that record observe them,
//! and freeze the messages around them.

use std::{fmt, sync::Arc};

use crate::{observers::Observers, time::Time};

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

static OBSERVERS: Observers<dyn IncidentObserver> = Observers::new();

/// Adds an observer, for as long as it lives. Returns `false` if there are too many.
pub fn observe(observer: &Arc<dyn IncidentObserver>) -> bool {
    OBSERVERS.add(observer, None)
}

/// Reports an incident to all observers. It never waits, also where other threads report incidents or add observers at
/// this moment: an observer that is just being added may miss it. It may be called from a panic hook.
pub fn report(at: Time, kind: IncidentKind, cause: fmt::Arguments<'_>) {
    let mut text = None;
    OBSERVERS.each(|observer| {
        let cause = text.get_or_insert_with(|| cause.to_string());
        observer.happened(at, kind, cause);
    });
}

#[cfg(test)]
mod tests {
    use std::sync::Mutex;

    use super::*;
    use crate::lock;

    /// Held by each test: an observer that a test drops is not in use by another one.
    static ALONE: Mutex<()> = Mutex::new(());

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
        let _alone = lock(&ALONE);
        let notes = Arc::new(Notes::default());
        let observer: Arc<dyn IncidentObserver> = notes.clone();
        assert!(observe(&observer));
        let at = Time::from_nanos(7);
        report(at, IncidentKind::Failure, format_args!("test of incidents {}", 1));
        assert_eq!(lock(&notes.0)[0], (at, "test of incidents 1".to_owned()));
        let weak = Arc::downgrade(&notes);
        drop((observer, notes));
        report(at, IncidentKind::Failure, format_args!("test of incidents 2"));
        assert_eq!(weak.strong_count(), 0);
    }

    #[test]
    fn incident_while_an_observer_is_added_is_reported() {
        let _alone = lock(&ALONE);
        let notes = Arc::new(Notes::default());
        let observer: Arc<dyn IncidentObserver> = notes.clone();
        assert!(observe(&observer));
        // Given: another observer is being added
        let change = OBSERVERS.while_changed();
        // When
        report(Time::from_nanos(8), IncidentKind::Failure, format_args!("test of incidents"));
        // Then
        assert_eq!(lock(&notes.0).len(), 1);
        drop(change);
    }

    #[test]
    fn incidents_of_several_threads_are_all_reported() {
        const THREADS: usize = 4;
        const INCIDENTS: usize = 1_000;
        let _alone = lock(&ALONE);
        let notes = Arc::new(Notes::default());
        let observer: Arc<dyn IncidentObserver> = notes.clone();
        assert!(observe(&observer));
        let begin = std::sync::Barrier::new(THREADS);
        std::thread::scope(|scope| {
            for _ in 0..THREADS {
                scope.spawn(|| {
                    begin.wait();
                    for _ in 0..INCIDENTS {
                        report(
                            Time::from_nanos(9),
                            IncidentKind::Failure,
                            format_args!("test of incidents 9"),
                        );
                    }
                });
            }
        });
        let received = lock(&notes.0).iter().filter(|(_, cause)| cause.ends_with(" 9")).count();
        assert_eq!(received, THREADS * INCIDENTS);
    }
}
