//! The clock, the timer and the pauses of a simulated process.

use std::{collections::VecDeque, time::Duration};

use sinew_runtime::time::Time;

/// The clock of a host: it agrees with no other clock, and may run too fast or too slowly.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Clock {
    /// Nanoseconds by which this clock was ahead of the world's at `since`.
    ahead_ns: i64,
    /// Nanoseconds per millisecond that this clock gains.
    fast_ppm: i64,
    since: Time,
}

impl Clock {
    /// Creates a clock that is ahead of the world's clock by `ahead_ns` at `now`, and gains `fast_ppm`
    /// microseconds in each second. Both may be negative.
    #[must_use]
    pub const fn new(now: Time, ahead_ns: i64, fast_ppm: i64) -> Self {
        Self { ahead_ns, fast_ppm, since: now }
    }

    /// Returns the reading of this clock at a time of the world.
    ///
    /// # Panics
    /// If more than 290 years have passed.
    #[must_use]
    pub fn read(&self, at: Time) -> Time {
        let elapsed = i128::from(at.as_nanos()) - i128::from(self.since.as_nanos());
        let drift = elapsed * i128::from(self.fast_ppm) / 1_000_000;
        at.shifted(self.ahead_ns + i64::try_from(drift).expect("a short run"))
    }

    /// Returns the time of the world at which this clock reads at least `then`, not before `now`.
    ///
    /// # Panics
    /// If the wait is longer than 580 years.
    #[must_use]
    pub fn when(&self, now: Time, then: Time) -> Time {
        let wait = then.since(self.read(now));
        if wait.is_zero() {
            return now;
        }
        // Rounded up: a timer is never early.
        let nanos = wait.as_nanos() * 1_000_000 / u128::from((1_000_000 + self.fast_ppm).unsigned_abs()) + 2;
        now + Duration::from_nanos(u64::try_from(nanos).expect("a short wait"))
    }

    /// Moves this clock by `nanos`, which may be negative, at `now`.
    pub fn jump(&mut self, now: Time, nanos: i64) {
        let ahead = i128::from(self.read(now).as_nanos()) - i128::from(now.as_nanos());
        self.ahead_ns = i64::try_from(ahead).unwrap_or(i64::MAX).saturating_add(nanos);
        self.since = now;
    }
}

/// The timer of a process, for its event in the world's queue. An event that was replaced is ignored.
#[derive(Clone, Copy, Debug, Default)]
pub struct Timer {
    at: Option<Time>,
}

impl Timer {
    /// Sets the timer. Returns whether an event for this time must be inserted: none earlier is pending.
    pub fn set(&mut self, at: Time) -> bool {
        let is_earlier = self.at.is_none_or(|set| at < set);
        if is_earlier {
            self.at = Some(at);
        }
        is_earlier
    }

    /// Returns whether the timer's present event is the one of `now`, and clears it then.
    pub fn expires(&mut self, now: Time) -> bool {
        self.at.take_if(|at| *at <= now).is_some()
    }

    /// Clears the timer.
    pub const fn clear(&mut self) {
        self.at = None;
    }
}

/// The pauses of a process: datagrams that arrive meanwhile wait in its socket.
#[derive(Clone, Debug)]
pub struct Stall<E> {
    until: Option<Time>,
    held: VecDeque<E>,
    held_max: usize,
}

impl<E> Stall<E> {
    /// Creates a running process with a socket for `held_max` events.
    #[must_use]
    pub const fn new(held_max: usize) -> Self {
        Self { until: None, held: VecDeque::new(), held_max }
    }

    /// Pauses the process until this time. A pause that lasts longer already is kept.
    pub fn pause(&mut self, until: Time) {
        self.until = self.until.max(Some(until));
    }

    /// Returns whether the process is paused.
    #[must_use]
    pub fn is_paused(&self, now: Time) -> bool {
        self.until.is_some_and(|until| now < until)
    }

    /// Keeps an event for the end of the pause.
    ///
    /// # Errors
    /// Returns the event if the socket is full.
    pub fn hold(&mut self, event: E) -> Result<(), E> {
        if self.held.len() >= self.held_max {
            return Err(event);
        }
        self.held.push_back(event);
        Ok(())
    }

    /// Ends a pause that is over. Returns the kept events in the order of their arrival.
    pub fn resume(&mut self, now: Time) -> Option<VecDeque<E>> {
        self.until.take_if(|until| *until <= now).map(|_| std::mem::take(&mut self.held))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn timer_of_a_drifting_clock_is_not_early() {
        let now = Time::from_nanos(1_000_000_000_000);
        for fast_ppm in [-500, 0, 499] {
            let clock = Clock::new(now, -7_000, fast_ppm);
            let then = clock.read(now) + Duration::from_secs(3);
            let at = clock.when(now, then);
            assert!(clock.read(at) >= then, "{fast_ppm}");
            assert!(clock.read(at) < then + Duration::from_nanos(9), "{fast_ppm}");
            assert_eq!(clock.when(at, then), at);
        }
    }

    #[test]
    fn jump_changes_the_reading_by_its_length() {
        let (start, later) = (Time::from_nanos(1_000_000_000), Time::from_nanos(9_000_000_000));
        let mut clock = Clock::new(start, 500, 100);
        let before = clock.read(later);
        clock.jump(later, -2_000);
        assert_eq!(clock.read(later), before.shifted(-2_000));
    }

    #[test]
    fn replaced_event_of_a_timer_is_ignored() {
        let at = Time::from_nanos;
        let mut timer = Timer::default();
        assert!(timer.set(at(20)));
        assert!(!timer.set(at(30)), "one before is pending");
        assert!(timer.set(at(10)));
        assert!(timer.expires(at(10)));
        assert!(!timer.expires(at(20)));
    }

    #[test]
    fn full_socket_of_a_paused_process_refuses() {
        let mut stall = Stall::new(2);
        stall.pause(Time::from_nanos(9));
        assert!(stall.is_paused(Time::from_nanos(8)));
        assert_eq!([stall.hold('a'), stall.hold('b'), stall.hold('c')], [Ok(()), Ok(()), Err('c')]);
        assert_eq!(stall.resume(Time::from_nanos(8)), None);
        assert_eq!(stall.resume(Time::from_nanos(9)), Some(VecDeque::from(['a', 'b'])));
    }
}
