//! How fast connections are accepted, whoever makes them: the thread that does it carries messages, too.
//!
//! A connection costs that thread a dozen system calls and several turns until it is gone: accepted, handed to the thread of handshakes, refused,
//! closed. Who it is from is not known before, so the pace is for all of them. It goes by time and by nothing that the other ends do: who comes
//! again as soon as he is closed, and so never lets two wait, has no more of the thread than who lets a thousand wait.

use std::time::Duration;

use sinew_runtime::time::Time;

/// Connections that are accepted without a [`REST`] between them at most, each in a turn of its own: no message waits longer for one than for
/// another one of 64 KiB.
pub(crate) const IN_A_ROW_MAX: u32 = 4;
/// One connection is saved up in each.
pub(crate) const REST: Duration = Duration::from_millis(1);
/// Connections that are saved up at most: those of 20 nodes that dial all they want at once wait for nothing but the rests between rows. In the
/// long run one is accepted each [`REST`]: those of 300 nodes within a second.
pub(crate) const SAVED_MAX: u32 = 64;

/// The pace of all listeners of a node together: one thread accepts for all of them.
#[derive(Debug)]
pub(crate) struct Pace {
    saved: u32,
    /// Until when it was saved up.
    as_of: Time,
    /// Connections that were accepted without a rest, the last of them at `last`.
    in_a_row: u32,
    last: Time,
}

impl Pace {
    /// That of one that has all saved up.
    pub(crate) const fn new(now: Time) -> Self {
        Self { saved: SAVED_MAX, as_of: now, in_a_row: 0, last: now }
    }

    /// How long to wait before one is accepted at `now`; then it is to be asked again.
    pub(crate) fn rest(&mut self, now: Time) -> Option<Duration> {
        self.pass_time(now);
        (self.saved == 0 || self.in_a_row >= IN_A_ROW_MAX).then_some(REST)
    }

    /// One was accepted, or failed to be, at `now`: it may have been waited for long.
    pub(crate) fn took_one(&mut self, now: Time) {
        self.pass_time(now);
        (self.in_a_row, self.last) = (self.in_a_row + 1, now);
        self.saved = self.saved.saturating_sub(1);
    }

    fn pass_time(&mut self, now: Time) {
        if now.since(self.last) >= REST {
            self.in_a_row = 0;
        }
        let passed = now.since(self.as_of).as_nanos() / REST.as_nanos();
        let passed = u32::try_from(passed).unwrap_or(u32::MAX);
        self.saved = self.saved.saturating_add(passed).min(SAVED_MAX);
        self.as_of = self.as_of + REST.saturating_mul(passed);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Has as many accepted as there may be until `end`, each of which takes `cost` and is followed by a `gap` in which nobody waits. Returns
    /// when each was.
    fn flood(pace: &mut Pace, mut now: Time, end: Time, (cost, gap): (Duration, Duration)) -> Vec<Time> {
        let mut taken = Vec::new();
        while now < end {
            if let Some(rest) = pace.rest(now) {
                now = now + rest;
                continue;
            }
            now = now + gap;
            pace.took_one(now);
            taken.push(now);
            now = now + cost;
        }
        taken
    }

    const COST: Duration = Duration::from_micros(50);

    fn at(millis: u64) -> Time {
        Time::ZERO + Duration::from_secs(1) + Duration::from_millis(millis)
    }

    #[test]
    fn who_comes_again_as_soon_as_he_is_closed_has_no_more_than_who_lets_many_wait() {
        for gap in [Duration::ZERO, Duration::from_micros(30), Duration::from_micros(200)] {
            let mut pace = Pace::new(at(0));
            let taken = flood(&mut pace, at(0), at(1_000), (COST, gap));
            assert!(taken.len() <= 1_000 + SAVED_MAX as usize, "{gap:?}: {}", taken.len());
            assert!(taken.len() >= 900, "{gap:?}: {}", taken.len());
            let mut rows = taken.windows(IN_A_ROW_MAX as usize + 1);
            assert!(rows.all(|row| row[row.len() - 1].since(row[0]) >= REST), "{gap:?}");
        }
    }

    #[test]
    fn what_was_saved_up_is_taken_in_rows_and_saved_up_again_in_the_quiet() {
        let mut pace = Pace::new(at(0));
        let rows = u64::from(SAVED_MAX / IN_A_ROW_MAX);
        // A row and its rest are over within two.
        for begin in [0, 10_000] {
            let taken = flood(&mut pace, at(begin), at(begin + 2 * rows), (COST, Duration::ZERO));
            assert!(taken.len() >= SAVED_MAX as usize, "{} from {begin} ms on", taken.len());
        }
    }

    #[test]
    fn whoever_comes_into_the_quiet_is_taken_at_once() {
        let mut pace = Pace::new(at(0));
        flood(&mut pace, at(0), at(100), (COST, Duration::ZERO));
        assert_eq!(pace.rest(at(500)), None);
        // It was waited for: a row begins when its first one comes.
        for _ in 0..IN_A_ROW_MAX {
            pace.took_one(at(900));
        }
        assert_eq!(pace.rest(at(900)), Some(REST));
        assert_eq!(pace.rest(at(901)), None);
    }
}
