//! Measures how late the calling thread wakes from sleeps to absolute deadlines.

use std::time::Duration;

use super::Lateness;
use crate::{
    supervision::request_priority,
    thread::{reset_schedule, system},
    time::Time,
};

/// Maximum number of turns of one probe: an hour at 1 kHz.
const TURNS_MAX: u32 = 3_600_000;

/// A measurement: which schedule, how often the thread wakes, and how many times.
///
/// # Examples
///
/// ```
/// use std::time::Duration;
/// use sinew::{protection::SAFE_OUTPUT_PRIORITY, real_time::Plan};
///
/// let plan = Plan::new(Some(SAFE_OUTPUT_PRIORITY), Duration::from_secs(2));
/// assert_eq!((plan.period, plan.turns), (Duration::from_millis(1), 2_000));
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Plan {
    /// The SCHED_FIFO priority to request, 1 to 99; `None`: the ordinary schedule.
    pub priority: Option<u8>,
    /// Time between two deadlines.
    pub period: Duration,
    /// Number of deadlines.
    pub turns: u32,
}

/// The result of a [`probe`].
#[derive(Clone, Debug)]
pub struct Probe {
    /// The SCHED_FIFO priority that the thread had, 0 for the ordinary schedule: the requested one, or the highest
    /// granted one.
    pub granted: u8,
    /// The lateness of its wake-ups.
    pub lateness: Lateness,
}

impl Plan {
    /// Returns the plan of a thread that wakes at 1 kHz for `length`: at least once, at most for an hour.
    #[must_use]
    pub fn new(priority: Option<u8>, length: Duration) -> Self {
        let turns = u32::try_from(length.as_millis()).unwrap_or(TURNS_MAX).clamp(1, TURNS_MAX);
        Self { priority, period: Duration::from_millis(1), turns }
    }
}

/// Measures the lateness of the calling thread, which should be new: its schedule and its CPUs are those of the process
/// afterwards. It ends early once `may_continue` returns `false`, which it calls before each sleep.
///
/// A wake-up after the next deadline makes that one late as well, so each missed turn counts with its own lateness.
/// A turn costs one wake-up, and allocates nothing.
///
/// # Examples
///
/// ```
/// use std::time::Duration;
/// use sinew::real_time::{Plan, probe};
///
/// let plan = Plan::new(None, Duration::from_millis(5));
/// let found = std::thread::spawn(move || probe(&plan, || true)).join().expect("it does not panic");
/// assert_eq!((found.granted, found.lateness.summary().turns), (0, 5));
/// ```
pub fn probe(plan: &Plan, may_continue: impl Fn() -> bool) -> Probe {
    let mut lateness = Lateness::new();
    reset_schedule();
    let granted = plan.priority.map_or(0, request_priority);
    let begin = Time::now();
    for turn in 1..=plan.turns {
        if !may_continue() {
            break;
        }
        lateness.record(wake_at(begin + plan.period * turn));
    }
    reset_schedule();
    Probe { granted, lateness }
}

/// Sleeps until `due`. Returns how late the thread woke.
fn wake_at(due: Time) -> Duration {
    loop {
        system::sleep_until(due);
        let now = Time::now();
        // A signal may have ended the sleep.
        if now >= due {
            return now.since(due);
        }
    }
}

#[cfg(test)]
mod tests {
    use std::cell::Cell;

    use super::*;

    #[test]
    fn probe_ends_once_it_may_not_continue() {
        let asked = Cell::new(0);
        let may_continue = || {
            asked.set(asked.get() + 1);
            asked.get() <= 3
        };
        let found = probe(&Plan::new(None, Duration::from_secs(60)), may_continue);
        assert_eq!((found.granted, found.lateness.summary().turns), (0, 3));
    }

    #[test]
    fn turns_of_a_plan_are_bounded() {
        assert_eq!(Plan::new(None, Duration::ZERO).turns, 1);
        assert_eq!(Plan::new(None, Duration::MAX).turns, TURNS_MAX);
    }
}
