//! How long a send waits for room. Pure: the time and the peer's read counter are parameters.

use std::time::Duration;

use sinew_runtime::time::Time;

use super::ApiError;

/// The limits of a send's wait for room.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Limit {
    /// Maximum time in which the peer reads nothing; `None` if the peer's progress does not matter.
    stall_timeout: Option<Duration>,
    /// Maximum total time.
    in_all: Duration,
}

impl Limit {
    /// Returns a limit that waits as long as the peer reads, and then for `stall_timeout` more.
    pub(super) const fn stall_timeout(stall_timeout: Duration) -> Self {
        Self { stall_timeout: Some(stall_timeout), in_all: Duration::MAX }
    }

    /// Returns a limit on the total time, regardless of the peer's progress. Zero: no wait.
    pub(super) const fn in_all(within: Duration) -> Self {
        Self { stall_timeout: None, in_all: within }
    }

    /// Returns the same limit with this additional limit on the total time.
    pub(super) fn and_in_all(self, within: Duration) -> Self {
        Self { stall_timeout: self.stall_timeout, in_all: self.in_all.min(within) }
    }

    /// Returns the time left for an answer that must arrive before the send.
    pub(super) fn time(&self) -> Duration {
        self.stall_timeout.map_or(self.in_all, |stall_timeout| stall_timeout.min(self.in_all))
    }

    /// Returns whether the caller has limited the total time, regardless of the peer's progress.
    pub(super) const fn is_in_all(&self) -> bool {
        self.stall_timeout.is_none()
    }

    /// Returns whether the limit leaves `time` for a step other than the wait for room. A send without
    /// waiting, or with a shorter limit, does not.
    pub(super) fn leaves(&self, time: Duration) -> bool {
        self.stall_timeout.is_some() && self.in_all >= time
    }

    fn stall_deadline(&self, now: Time) -> Time {
        self.stall_timeout.map_or(Time::MAX, |stall_timeout| now + stall_timeout)
    }
}

/// The wait of one send, which starts when there is no room for the first time.
#[derive(Debug)]
pub(super) struct Waiting {
    limit: Limit,
    /// The limit as reported in the error.
    reported: Duration,
    end: Option<Time>,
    /// The peer's read counter when its time started, and the end of that time.
    turn: Option<(u32, Time)>,
}

impl Waiting {
    pub(super) fn new(limit: Limit) -> Self {
        Self {
            limit,
            reported: limit.stall_timeout.unwrap_or(limit.in_all).min(limit.in_all),
            end: None,
            turn: None,
        }
    }

    /// Returns the wait of a send to a peer that has read nothing since the stall timeout of an earlier send:
    /// that timeout counts for all sends. A caller's limit on the total time still applies.
    pub(super) fn after_stall(limit: Limit) -> Self {
        let stall_timeout = limit.stall_timeout.map(|_| Duration::ZERO);
        Self { limit: Limit { stall_timeout, in_all: limit.in_all }, ..Self::new(limit) }
    }

    /// Returns the time to wait until, or `None` if the wait is over. `taken` is the peer's read counter: a
    /// change since the last call restarts the peer's time.
    pub(super) fn until(&mut self, taken: u32, now: Time) -> Option<Time> {
        let end = *self.end.get_or_insert_with(|| now + self.limit.in_all);
        let turn = match self.turn {
            Some((before, until)) if before == taken => until,
            Some(_) | None => self.limit.stall_deadline(now),
        };
        self.turn = Some((taken, turn));
        let until = end.min(turn);
        (now < until).then_some(until)
    }

    /// Returns whether there was no room at some time.
    pub(super) const fn has_begun(&self) -> bool {
        self.turn.is_some()
    }

    /// Returns whether the peer has read nothing for the stall timeout.
    pub(super) fn has_stalled(&self, now: Time) -> bool {
        !self.limit.is_in_all() && self.turn.is_some_and(|(_, until)| now >= until)
    }

    /// Returns the error for a wait that has failed.
    pub(super) const fn error(&self) -> ApiError {
        ApiError::Stalled(self.reported)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const SECOND: Duration = Duration::from_secs(1);

    fn at(milliseconds: u64) -> Time {
        Time::ZERO + Duration::from_millis(milliseconds)
    }

    #[test]
    fn stall_timeout_covers_time_without_peer_progress() {
        let mut waiting = Waiting::new(Limit::stall_timeout(SECOND));
        assert_eq!(waiting.until(7, at(0)), Some(at(1_000)));
        assert_eq!(waiting.until(7, at(999)), Some(at(1_000)));
        // The peer reads a little each time.
        for step in 1..=10 {
            assert_eq!(
                waiting.until(7 + step, at(900 * u64::from(step))),
                Some(at(900 * u64::from(step) + 1_000))
            );
        }
        assert_eq!(waiting.until(17, at(10_000)), None);
    }

    #[test]
    fn late_progress_restarts_the_timeout() {
        let mut waiting = Waiting::new(Limit::stall_timeout(SECOND));
        assert_eq!(waiting.until(0, at(0)), Some(at(1_000)));
        assert_eq!(waiting.until(1, at(1_000)), Some(at(2_000)));
        assert_eq!(waiting.until(1, at(2_000)), None);
    }

    #[test]
    fn total_limit_ignores_peer_progress() {
        let mut waiting = Waiting::new(Limit::in_all(SECOND));
        assert_eq!(waiting.until(0, at(0)), Some(at(1_000)));
        assert_eq!(waiting.until(1, at(999)), Some(at(1_000)));
        assert_eq!(waiting.until(2, at(1_000)), None);
        let mut both = Waiting::new(Limit::stall_timeout(SECOND).and_in_all(SECOND / 2));
        assert_eq!(both.until(0, at(0)), Some(at(500)));
        assert_eq!(both.until(1, at(500)), None);
    }

    #[test]
    fn zero_limit_never_waits() {
        assert_eq!(Waiting::new(Limit::in_all(Duration::ZERO)).until(0, at(5)), None);
        assert_eq!(Waiting::after_stall(Limit::stall_timeout(SECOND)).until(0, at(5)), None);
    }

    #[test]
    fn after_stall_only_explicit_limits_wait() {
        let mut waiting = Waiting::after_stall(Limit::in_all(SECOND));
        assert_eq!(waiting.until(0, at(0)), Some(at(1_000)));
        assert_eq!(waiting.until(0, at(1_000)), None);
        assert!(!waiting.has_stalled(at(1_000)), "other sends may have more time");
        let mut waiting = Waiting::new(Limit::stall_timeout(SECOND).and_in_all(SECOND / 2));
        assert_eq!((waiting.until(0, at(0)), waiting.until(0, at(500))), (Some(at(500)), None));
        assert!(!waiting.has_stalled(at(500)) && waiting.has_stalled(at(1_000)));
    }

    #[test]
    fn endless_limit_never_ends() {
        let mut waiting = Waiting::new(Limit::in_all(Duration::MAX));
        assert_eq!(waiting.until(0, at(5)), Some(Time::MAX));
        assert_eq!(waiting.until(0, at(1 << 40)), Some(Time::MAX));
        let endless = Limit::stall_timeout(Duration::MAX);
        assert!(!endless.is_in_all(), "it may take the time to reconnect to a node");
        assert_eq!(Waiting::new(endless).until(0, at(5)), Some(Time::MAX));
    }
}
