//! How long a send waits for room. Pure: the time and what the peer has taken come in.

use std::time::Duration;

use sinew_runtime::time::Time;

use super::ApiError;

/// What a send may wait for room.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Limit {
    /// Time in which the peer takes nothing; `None` if it does not matter what it takes.
    stall_timeout: Option<Duration>,
    /// Time in all.
    in_all: Duration,
}

impl Limit {
    /// As long as the peer goes on taking, and then so much longer.
    pub(super) const fn stall_timeout(stall_timeout: Duration) -> Self {
        Self { stall_timeout: Some(stall_timeout), in_all: Duration::MAX }
    }

    /// So long at most, whatever the peer takes. Zero: not at all.
    pub(super) const fn in_all(within: Duration) -> Self {
        Self { stall_timeout: None, in_all: within }
    }

    /// The same, and so long at most.
    pub(super) fn and_in_all(self, within: Duration) -> Self {
        Self { stall_timeout: self.stall_timeout, in_all: self.in_all.min(within) }
    }

    /// How long it leaves at most for an answer that comes before the send.
    pub(super) fn time(&self) -> Duration {
        self.stall_timeout.map_or(self.in_all, |stall_timeout| stall_timeout.min(self.in_all))
    }

    /// Whether the caller has said how long it takes in all, whatever the peer takes.
    pub(super) const fn is_in_all(&self) -> bool {
        self.stall_timeout.is_none()
    }

    /// Whether it leaves `time` for something else than room: what is only to be tried at once does not, nor what ends before.
    pub(super) fn leaves(&self, time: Duration) -> bool {
        self.stall_timeout.is_some() && self.in_all >= time
    }

    fn patience_from(&self, now: Time) -> Time {
        self.stall_timeout.map_or(Time::MAX, |stall_timeout| now + stall_timeout)
    }
}

/// The wait of one send, which begins when there is no room for the first time.
#[derive(Debug)]
pub(super) struct Waiting {
    limit: Limit,
    /// How long that is, in words.
    told: Duration,
    end: Option<Time>,
    /// What the peer had taken when its time began, and when that is over.
    turn: Option<(u32, Time)>,
}

impl Waiting {
    pub(super) fn new(limit: Limit) -> Self {
        Self {
            limit,
            told: limit.stall_timeout.unwrap_or(limit.in_all).min(limit.in_all),
            end: None,
            turn: None,
        }
    }

    /// The same where the peer, as far as is known, has taken nothing since another one's stall timeout was over: that was the
    /// time for all. Who has said a time in all has it.
    pub(super) fn after_a_stall(limit: Limit) -> Self {
        let stall_timeout = limit.stall_timeout.map(|_| Duration::ZERO);
        Self { limit: Limit { stall_timeout, in_all: limit.in_all }, ..Self::new(limit) }
    }

    /// Until when to wait; `None` if it has lasted long enough. `taken`: a count of what the peer takes, which starts its
    /// time anew when it is another one than at the last look.
    pub(super) fn until(&mut self, taken: u32, now: Time) -> Option<Time> {
        let end = *self.end.get_or_insert_with(|| now + self.limit.in_all);
        let turn = match self.turn {
            Some((before, until)) if before == taken => until,
            Some(_) | None => self.limit.patience_from(now),
        };
        self.turn = Some((taken, turn));
        let until = end.min(turn);
        (now < until).then_some(until)
    }

    /// Whether there was no room at some time.
    pub(super) const fn has_begun(&self) -> bool {
        self.turn.is_some()
    }

    /// Whether the peer has taken nothing for as long as the stall timeout lasts.
    pub(super) fn is_out_of_patience(&self, now: Time) -> bool {
        !self.limit.is_in_all() && self.turn.is_some_and(|(_, until)| now >= until)
    }

    /// What its caller is told when it was in vain.
    pub(super) const fn in_vain(&self) -> ApiError {
        ApiError::Stalled(self.told)
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
    fn patience_lasts_for_the_time_in_which_the_peer_takes_nothing() {
        let mut waiting = Waiting::new(Limit::stall_timeout(SECOND));
        assert_eq!(waiting.until(7, at(0)), Some(at(1_000)));
        assert_eq!(waiting.until(7, at(999)), Some(at(1_000)));
        // It takes a little each time.
        for step in 1..=10 {
            assert_eq!(
                waiting.until(7 + step, at(900 * u64::from(step))),
                Some(at(900 * u64::from(step) + 1_000))
            );
        }
        assert_eq!(waiting.until(17, at(10_000)), None);
    }

    #[test]
    fn what_was_taken_just_before_the_end_begins_the_time_anew() {
        let mut waiting = Waiting::new(Limit::stall_timeout(SECOND));
        assert_eq!(waiting.until(0, at(0)), Some(at(1_000)));
        assert_eq!(waiting.until(1, at(1_000)), Some(at(2_000)));
        assert_eq!(waiting.until(1, at(2_000)), None);
    }

    #[test]
    fn a_bound_in_all_is_one_whatever_the_peer_takes() {
        let mut waiting = Waiting::new(Limit::in_all(SECOND));
        assert_eq!(waiting.until(0, at(0)), Some(at(1_000)));
        assert_eq!(waiting.until(1, at(999)), Some(at(1_000)));
        assert_eq!(waiting.until(2, at(1_000)), None);
        let mut both = Waiting::new(Limit::stall_timeout(SECOND).and_in_all(SECOND / 2));
        assert_eq!(both.until(0, at(0)), Some(at(500)));
        assert_eq!(both.until(1, at(500)), None);
    }

    #[test]
    fn no_time_is_no_wait_at_all() {
        assert_eq!(Waiting::new(Limit::in_all(Duration::ZERO)).until(0, at(5)), None);
        assert_eq!(Waiting::after_a_stall(Limit::stall_timeout(SECOND)).until(0, at(5)), None);
    }

    #[test]
    fn after_a_stall_only_who_has_said_how_long_waits() {
        let mut waiting = Waiting::after_a_stall(Limit::in_all(SECOND));
        assert_eq!(waiting.until(0, at(0)), Some(at(1_000)));
        assert_eq!(waiting.until(0, at(1_000)), None);
        assert!(!waiting.is_out_of_patience(at(1_000)), "others may have more");
        let mut waiting = Waiting::new(Limit::stall_timeout(SECOND).and_in_all(SECOND / 2));
        assert_eq!((waiting.until(0, at(0)), waiting.until(0, at(500))), (Some(at(500)), None));
        assert!(!waiting.is_out_of_patience(at(500)) && waiting.is_out_of_patience(at(1_000)));
    }

    #[test]
    fn for_ever_is_for_ever() {
        let mut waiting = Waiting::new(Limit::in_all(Duration::MAX));
        assert_eq!(waiting.until(0, at(5)), Some(Time::MAX));
        assert_eq!(waiting.until(0, at(1 << 40)), Some(Time::MAX));
        let endless = Limit::stall_timeout(Duration::MAX);
        assert!(!endless.is_in_all(), "it may take the time to come back to a node");
        assert_eq!(Waiting::new(endless).until(0, at(5)), Some(Time::MAX));
    }
}
