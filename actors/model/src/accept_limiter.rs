//! Limits how fast connections are accepted, from any source: the accepting thread also carries messages.
//!
//! A connection costs that thread a dozen system calls and several turns: accept, handover to the handshake
//! thread, refusal, close. Its source is not known before, so the limit applies to all connections. It
//! depends on time alone, and not on the behaviour of the other ends. A client that reconnects as soon as it
//! is closed, so that two never wait, gets no more of the thread than one with a thousand waiting
//! connections.

use std::time::Duration;

use sinew_runtime::time::Time;

use crate::rate_limiter::{Rate, RateLimiter};

/// Maximum number of connections accepted without a [`PAUSE`] between them, each in a turn of its own. A
/// connection delays a message no longer than another message of 64 KiB does.
pub const IN_A_ROW_MAX: u32 = 4;
/// The time in which one more connection becomes available.
pub const PAUSE: Duration = Duration::from_millis(1);
/// Maximum number of available connections: those of 20 nodes that dial at once wait only for the pauses
/// between rows. In the long run one is accepted per [`PAUSE`]: those of 300 nodes within a second.
pub const BURST_MAX: u32 = 64;

/// The limiter for all listeners of a node together: one thread accepts for all of them.
#[derive(Debug)]
pub struct AcceptLimiter {
    rate: RateLimiter,
    row: AcceptRow,
}

impl AcceptLimiter {
    /// Returns a limiter with the maximum of available connections.
    #[must_use]
    pub const fn new(now: Time) -> Self {
        Self { rate: RateLimiter::new(Rate::new(PAUSE, BURST_MAX)), row: AcceptRow::new(now) }
    }

    /// Returns how long to wait before a connection is accepted at `now`; after that wait, call this again.
    #[must_use]
    pub fn delay(&self, now: Time) -> Option<Duration> {
        let delay = self.row.delay(now).unwrap_or_default().max(self.rate.delay(now));
        (!delay.is_zero()).then_some(delay)
    }

    /// Records that a connection was accepted at `now`, or that the accept failed: it may have waited long.
    pub fn on_accept(&mut self, now: Time) {
        self.rate.charge(now, PAUSE, PAUSE);
        self.row.on_accept(now);
    }
}

/// Connections accepted without a pause. This is no rate: only a [`PAUSE`] without a connection ends a row.
#[derive(Debug)]
pub struct AcceptRow {
    count: u32,
    last: Time,
}

impl AcceptRow {
    /// Creates the counter; no connection was accepted yet.
    #[must_use]
    pub const fn new(now: Time) -> Self {
        Self { count: 0, last: now }
    }

    /// Returns the time left of the pause before the next accept, if one is due at `now`.
    #[must_use]
    pub fn delay(&self, now: Time) -> Option<Duration> {
        let left = PAUSE.saturating_sub(now.since(self.last));
        (self.count >= IN_A_ROW_MAX && !left.is_zero()).then_some(left)
    }

    /// Records that a connection was accepted at `now`.
    pub fn on_accept(&mut self, now: Time) {
        if now.since(self.last) >= PAUSE {
            self.count = 0;
        }
        (self.count, self.last) = (self.count.saturating_add(1), now);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    /// Accepts connections at the maximum rate until `end`. Each takes `cost` and is followed by a `gap`
    /// without waiting clients. Returns the accept times.
    fn flood(
        limiter: &mut AcceptLimiter,
        mut now: Time,
        end: Time,
        (cost, gap): (Duration, Duration),
    ) -> Vec<Time> {
        let mut taken = Vec::new();
        while now < end {
            if let Some(delay) = limiter.delay(now) {
                now = now + delay;
                continue;
            }
            now = now + gap;
            limiter.on_accept(now);
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
    fn immediate_reconnects_are_accepted_no_more_often() {
        for gap in [Duration::ZERO, Duration::from_micros(30), Duration::from_micros(200)] {
            let mut limiter = AcceptLimiter::new(at(0));
            let taken = flood(&mut limiter, at(0), at(1_000), (COST, gap));
            assert!(taken.len() <= 1_000 + BURST_MAX as usize, "{gap:?}: {}", taken.len());
            assert!(taken.len() >= 900, "{gap:?}: {}", taken.len());
            let mut rows = taken.windows(IN_A_ROW_MAX as usize + 1);
            assert!(rows.all(|row| row[row.len() - 1].since(row[0]) >= PAUSE), "{gap:?}");
        }
    }

    #[test]
    fn budget_is_used_in_bursts_and_refills_when_idle() {
        let mut limiter = AcceptLimiter::new(at(0));
        let rows = u64::from(BURST_MAX / IN_A_ROW_MAX);
        // A row and its pause are over within two.
        for begin in [0, 10_000] {
            let taken = flood(&mut limiter, at(begin), at(begin + 2 * rows), (COST, Duration::ZERO));
            assert!(taken.len() >= BURST_MAX as usize, "{} from {begin} ms on", taken.len());
        }
    }

    #[test]
    fn first_connection_after_idle_is_accepted_at_once() {
        let mut limiter = AcceptLimiter::new(at(0));
        flood(&mut limiter, at(0), at(100), (COST, Duration::ZERO));
        assert_eq!(limiter.delay(at(500)), None);
        // The burst starts when its first client connects, after the wait.
        for _ in 0..IN_A_ROW_MAX {
            limiter.on_accept(at(900));
        }
        assert_eq!(limiter.delay(at(900)), Some(PAUSE));
        assert_eq!(limiter.delay(at(901)), None);
    }

    #[test]
    fn row_is_followed_by_a_pause_of_fixed_length() {
        let mut row = AcceptRow::new(at(0));
        for _ in 0..IN_A_ROW_MAX {
            assert_eq!(row.delay(at(10)), None);
            row.on_accept(at(10));
        }
        assert_eq!(row.delay(at(10)), Some(PAUSE));
        let half = PAUSE / 2;
        assert_eq!(row.delay(at(10) + half), Some(PAUSE - half));
        assert_eq!(row.delay(at(10) + PAUSE), None);
        row.on_accept(at(11));
        assert_eq!(row.delay(at(11)), None);
    }
}
