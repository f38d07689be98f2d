//! When the Bulk thread yields its CPU: after each turn, unless it was away for long the last time.
//!
//! Yielding lets threads that handle short Control work run first. If two or more threads compute without
//! pause on the same CPU, each of them uses a slice of milliseconds after every yield. No other wait becomes
//! shorter by that. In a measurement with four such threads, each turn of 64 short frames took 0.07 ms, and
//! the yield after it took 22 ms. Of 100,000 Bulk messages per second 3,000 were left. After such an absence
//! the thread therefore runs without yielding for as long as it was away. The scheduler can preempt it like
//! any other thread.
//!
//! The thread of handshakes has longer turns, for which no other thread waits. It runs for a millisecond
//! before it yields again, however short its absence was. Otherwise, if other threads compute on all CPUs, it
//! would get one step of a handshake per slice of theirs.

use std::{
    sync::atomic::{AtomicU64, Ordering},
    time::Duration,
};

use sinew_runtime::time::Time;

/// An absence longer than the slice of one computing thread: the scheduler checks the slices each 4 ms (250 Hz).
const LATE: Duration = Duration::from_millis(5);
/// Longest run without yielding, after an absence of any length.
const RUN_MAX: Duration = Duration::from_millis(20);

/// The yield policy of one thread.
#[derive(Debug, Default)]
pub(super) struct YieldPolicy {
    /// Shortest run after each absence.
    run_min: Duration,
    /// Time before which the thread does not yield, in nanoseconds. The thread's tasks share it; no other
    /// thread uses it.
    not_before: AtomicU64,
    /// Number of ended turns.
    #[cfg(test)]
    turns: AtomicU64,
}

impl YieldPolicy {
    /// Creates the policy of a thread with this shortest run.
    pub(super) fn with_min_run(run_min: Duration) -> Self {
        Self { run_min, ..Self::default() }
    }

    /// Records the end of a turn at `now`. Returns whether to yield the CPU. If so, the caller calls
    /// [`resumed`](Self::resumed) next.
    pub(super) fn should_yield(&self, now: Time) -> bool {
        #[cfg(test)]
        self.turns.fetch_add(1, Ordering::Relaxed);
        // SYNC: Relaxed; only one thread reads and writes it.
        now.as_nanos() >= self.not_before.load(Ordering::Relaxed)
    }

    /// Returns the number of ended turns.
    #[cfg(test)]
    pub(super) fn turns(&self) -> u64 {
        self.turns.load(Ordering::Relaxed)
    }

    /// Records a yield at `from` and the return at `now`.
    pub(super) fn resumed(&self, from: Time, now: Time) {
        let away = now.since(from);
        let run = if away >= LATE { away.min(RUN_MAX) } else { Duration::ZERO };
        // SYNC: see `should_yield`.
        self.not_before.store((now + run.max(self.run_min)).as_nanos(), Ordering::Relaxed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(micros: u64) -> Time {
        Time::ZERO + Duration::from_micros(1_000_000 + micros)
    }

    #[test]
    fn thread_yields_after_each_turn_while_it_returns_quickly() {
        let policy = YieldPolicy::default();
        for turn in 0..100 {
            let now = at(turn * 5_000);
            assert!(policy.should_yield(now));
            policy.resumed(now, now + Duration::from_micros(4_900));
        }
    }

    #[test]
    fn thread_runs_as_long_as_it_was_away() {
        let policy = YieldPolicy::default();
        policy.resumed(at(0), at(8_000));
        assert!(!policy.should_yield(at(8_000)) && !policy.should_yield(at(15_999)));
        assert!(policy.should_yield(at(16_000)));
        // A longer absence has another cause: a debugger, a suspended host.
        policy.resumed(at(16_000), at(90_000_000));
        assert!(!policy.should_yield(at(90_019_999)) && policy.should_yield(at(90_020_000)));
    }

    #[test]
    fn thread_does_not_yield_within_its_minimum_run() {
        let policy = YieldPolicy::with_min_run(Duration::from_millis(1));
        assert!(policy.should_yield(at(0)), "it has run for long");
        policy.resumed(at(0), at(10));
        assert!(!policy.should_yield(at(1_009)) && policy.should_yield(at(1_010)));
        policy.resumed(at(1_010), at(9_010));
        assert!(!policy.should_yield(at(17_009)) && policy.should_yield(at(17_010)));
    }

    #[test]
    fn thread_gets_several_turns_per_slice_beside_busy_ones() {
        // Given: each of four busy threads takes 4 ms after each yield, and a turn takes 70 us.
        let (turn, away) = (Duration::from_micros(70), Duration::from_millis(16));
        let (policy, mut now, mut ran) = (YieldPolicy::default(), at(0), Duration::ZERO);
        let end = now + Duration::from_secs(1);
        // When
        while now < end {
            now = now + turn;
            ran += turn;
            if policy.should_yield(now) {
                policy.resumed(now, now + away);
                now = now + away;
            }
        }
        // Then: it got more than 70 us of each 16 ms.
        assert!(ran > Duration::from_millis(300), "it ran for {ran:?} of a second");
    }
}
