//! When the thread of Bulk gives its CPU away: after each turn, unless it got it back late the last time.
//!
//! It is for those who have been woken for Control and are done in a moment. Where two or more threads compute without end on the same CPU, each of
//! them takes a slice of milliseconds whenever it is given away, and nobody's wait becomes shorter by it: four of them took 22 ms after each turn of 64
//! short frames, which took 0.07 ms, and 3,000 messages of Bulk a second were left of 100,000. So after such an absence the thread goes on without
//! giving way for as long as it was away; the system takes the CPU from it as from everybody else.
//!
//! The thread of handshakes, whose turns are longer and wait for nobody, runs for a millisecond before it gives way again, however soon it was back: where
//! others compute on all CPUs, it would have one step of a handshake for each of their slices.

use std::{
    sync::atomic::{AtomicU64, Ordering},
    time::Duration,
};

use sinew_runtime::time::Time;

/// An absence that is longer than the slice of one thread that computes: the system looks each 4 ms (250 Hz) whether a slice is over.
const LATE: Duration = Duration::from_millis(5);
/// However long it was away, it goes on without giving way for no longer than this.
const RUN_MAX: Duration = Duration::from_millis(20);

/// Whether to give way, of one thread.
#[derive(Debug, Default)]
pub(super) struct Courtesy {
    /// When it is back it goes on for so long at least.
    run_min: Duration,
    /// It does not before this, in nanoseconds. The thread's tasks have it in common, and nobody else has it.
    not_before: AtomicU64,
    /// Turns that have ended.
    #[cfg(test)]
    turns: AtomicU64,
}

impl Courtesy {
    /// Of a thread that goes on for so long at least when it is back.
    pub(super) fn after_runs_of(run_min: Duration) -> Self {
        Self { run_min, ..Self::default() }
    }

    /// A turn has ended at `now`: whether the CPU is to be given away. [`was_away`](Self::was_away) follows, if it was.
    pub(super) fn gives_way(&self, now: Time) -> bool {
        #[cfg(test)]
        self.turns.fetch_add(1, Ordering::Relaxed);
        // SYNC: Relaxed; one thread reads and writes it.
        now.as_nanos() >= self.not_before.load(Ordering::Relaxed)
    }

    /// Turns that have ended.
    #[cfg(test)]
    pub(super) fn turns(&self) -> u64 {
        self.turns.load(Ordering::Relaxed)
    }

    /// It was given away at `from`, and is back at `now`.
    pub(super) fn was_away(&self, from: Time, now: Time) {
        let away = now.since(from);
        let run = if away >= LATE { away.min(RUN_MAX) } else { Duration::ZERO };
        // SYNC: see `gives_way`.
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
    fn it_gives_way_after_each_turn_where_it_is_back_within_a_slice() {
        let courtesy = Courtesy::default();
        for turn in 0..100 {
            let now = at(turn * 5_000);
            assert!(courtesy.gives_way(now));
            courtesy.was_away(now, now + Duration::from_micros(4_900));
        }
    }

    #[test]
    fn where_several_compute_it_runs_as_long_as_it_was_away_and_gives_way_again_then() {
        let courtesy = Courtesy::default();
        courtesy.was_away(at(0), at(8_000));
        assert!(!courtesy.gives_way(at(8_000)) && !courtesy.gives_way(at(15_999)));
        assert!(courtesy.gives_way(at(16_000)));
        // Whatever kept it away so long: a debugger, a host that slept.
        courtesy.was_away(at(16_000), at(90_000_000));
        assert!(!courtesy.gives_way(at(90_019_999)) && courtesy.gives_way(at(90_020_000)));
    }

    #[test]
    fn who_has_runs_of_a_length_does_not_give_way_within_one() {
        let courtesy = Courtesy::after_runs_of(Duration::from_millis(1));
        assert!(courtesy.gives_way(at(0)), "it has run for long");
        courtesy.was_away(at(0), at(10));
        assert!(!courtesy.gives_way(at(1_009)) && courtesy.gives_way(at(1_010)));
        courtesy.was_away(at(1_010), at(9_010));
        assert!(!courtesy.gives_way(at(17_009)) && courtesy.gives_way(at(17_010)));
    }

    #[test]
    fn beside_several_that_compute_it_is_left_more_than_one_turn_for_each_of_their_slices() {
        // Given: each of four takes 4 ms whenever it is given away, and a turn takes 70 us.
        let (turn, away) = (Duration::from_micros(70), Duration::from_millis(16));
        let (courtesy, mut now, mut ran) = (Courtesy::default(), at(0), Duration::ZERO);
        let end = now + Duration::from_secs(1);
        // When
        while now < end {
            now = now + turn;
            ran += turn;
            if courtesy.gives_way(now) {
                courtesy.was_away(now, now + away);
                now = now + away;
            }
        }
        // Then: it was not 70 us of each 16 ms.
        assert!(ran > Duration::from_millis(300), "it ran for {ran:?} of a second");
    }
}
