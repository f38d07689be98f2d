//! The total lateness of the watchdog's checks: time in which the process was stopped, or the host was suspended.

use std::{
    sync::{
        Mutex,
        atomic::{AtomicUsize, Ordering},
    },
    time::Duration,
};

use super::PERIOD_MAX;
use crate::{lock, time::Time};

/// Lateness that is ordinary for the system.
const ORDINARY: Duration = Duration::from_millis(1);

/// The watchdog's lateness. It is kept up to date while it has readers.
#[derive(Debug, Default)]
pub(super) struct Lateness {
    state: Mutex<State>,
    readers: AtomicUsize,
}

#[derive(Clone, Copy, Debug, Default)]
struct State {
    sum: Duration,
    /// When the next check is due; `None` if none is.
    due: Option<Time>,
}

impl State {
    fn late(&self, now: Time) -> Duration {
        let late = self.due.map_or(Duration::ZERO, |due| now.since(due));
        Some(late).filter(|late| *late > ORDINARY).unwrap_or_default()
    }
}

impl Lateness {
    /// Records a check. Returns how late it is.
    pub(super) fn record_check(&self, now: Time) -> Duration {
        let mut state = lock(&self.state);
        let late = state.late(now);
        // The thread may be suspended before it records when the next check is due.
        *state = State { sum: state.sum + late, due: Some(now + PERIOD_MAX) };
        late
    }

    /// Records when the next check is due.
    pub(super) fn set_due(&self, at: Option<Time>) {
        lock(&self.state).due = at;
    }

    /// Returns the total lateness so far, including that of a check that is overdue at this moment.
    pub(super) fn sum(&self, now: Time) -> Duration {
        let state = *lock(&self.state);
        state.sum + state.late(now)
    }

    pub(super) fn has_readers(&self) -> bool {
        self.readers.load(Ordering::Relaxed) > 0
    }

    /// Registers a reader. The watchdog must be woken after this: its check is due.
    pub(super) fn add_reader(&self, now: Time) {
        self.readers.fetch_add(1, Ordering::Relaxed);
        let mut state = lock(&self.state);
        let at_latest = now + PERIOD_MAX;
        state.due = Some(state.due.map_or(at_latest, |due| due.min(at_latest)));
    }

    pub(super) fn remove_reader(&self) {
        self.readers.fetch_sub(1, Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const fn ms(ms: u64) -> Time {
        Time::from_nanos(ms * 1_000_000)
    }

    #[test]
    fn overdue_check_counts_once_before_it_runs() {
        let lateness = Lateness::default();
        lateness.set_due(Some(ms(5)));
        assert_eq!(lateness.sum(ms(6)), Duration::ZERO, "the ordinary lateness");
        assert_eq!(lateness.sum(ms(305)), Duration::from_millis(300));
        assert_eq!(lateness.record_check(ms(405)), Duration::from_millis(400));
        assert_eq!(lateness.sum(ms(510)), Duration::from_millis(500), "the next one may never come");
        lateness.set_due(None);
        assert_eq!(lateness.sum(ms(9_999)), Duration::from_millis(400), "it sleeps until it is needed");
        lateness.add_reader(ms(9_995));
        assert_eq!(lateness.sum(ms(10_100)), Duration::from_millis(500), "it does not come when it is");
        lateness.set_due(Some(ms(10_350)));
        lateness.add_reader(ms(10_095));
        assert_eq!(lateness.sum(ms(10_200)), Duration::from_millis(500), "woken for the reader, it is late");
    }
}
