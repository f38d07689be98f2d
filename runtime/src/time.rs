//! Points in time: nanoseconds of the host's monotonic clock.
//!
//! The clock counts since the boot of the host, on Linux without sleep time, and is the same for all
//! processes of a host. Cores never read it: a time is passed as an argument, so that a seed replays a
//! failure. Only shells call [`Time::now`].

use std::{
    fmt,
    ops::{Add, Sub},
    time::Duration,
};

use rustix::time::{ClockId, clock_gettime};
use serde::{Deserialize, Serialize};

/// A point in time, in nanoseconds of `CLOCK_MONOTONIC`.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// let sent = Time::from_nanos(1_000_000);
/// let handled = sent + Duration::from_micros(250);
/// assert_eq!(handled.since(sent), Duration::from_micros(250));
/// ```
#[derive(Clone, Copy, Default, PartialEq, Eq, PartialOrd, Ord, Hash, Serialize, Deserialize)]
#[serde(transparent)]
pub struct Time(u64);

impl Time {
    /// The origin of the clock.
    pub const ZERO: Self = Self(0);
    /// Later than every other time.
    pub const MAX: Self = Self(u64::MAX);

    /// Returns the current time. For shells only.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::Time;
    ///
    /// let begin = Time::now();
    /// // One turn of a control loop.
    /// println!("the turn took {:?}", Time::now().since(begin));
    /// ```
    #[must_use]
    #[inline]
    pub fn now() -> Self {
        Self::of(ClockId::Monotonic)
    }

    /// Returns the current time, and a lower bound of the host's sleep since its boot, during which this
    /// clock stops. For shells only.
    ///
    /// A thread that is delayed between its two clock reads finds less sleep than there was, never more. On
    /// systems other than Linux the sleep is unknown, and this returns zero.
    #[must_use]
    pub fn now_and_asleep() -> (Self, Duration) {
        #[cfg(target_os = "linux")]
        let with_sleep = Self::of(ClockId::Boottime);
        let now = Self::now();
        #[cfg(target_os = "linux")]
        return (now, with_sleep.since(now));
        #[cfg(not(target_os = "linux"))]
        return (now, Duration::ZERO);
    }

    #[inline]
    fn of(clock: ClockId) -> Self {
        let now = clock_gettime(clock);
        // These clocks start at zero and cannot be negative.
        Self(now.tv_sec.unsigned_abs() * 1_000_000_000 + now.tv_nsec.unsigned_abs())
    }

    /// Returns the time `nanos` nanoseconds after the clock's origin.
    #[must_use]
    pub const fn from_nanos(nanos: u64) -> Self {
        Self(nanos)
    }

    /// Returns the nanoseconds since the clock's origin.
    #[must_use]
    pub const fn as_nanos(self) -> u64 {
        self.0
    }

    /// Returns the time from `earlier` to this; zero if this is not later.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::prelude::*;
    ///
    /// let (earlier, later) = (Time::from_nanos(5_000), Time::from_nanos(7_000));
    /// assert_eq!(later.since(earlier), Duration::from_micros(2));
    /// assert_eq!(earlier.since(later), Duration::ZERO);
    /// ```
    #[must_use]
    pub const fn since(self, earlier: Self) -> Duration {
        Duration::from_nanos(self.0.saturating_sub(earlier.0))
    }

    /// Returns this time moved by `nanos`, which may be negative; never before the clock's origin.
    #[must_use]
    pub const fn shifted(self, nanos: i64) -> Self {
        Self(self.0.saturating_add_signed(nanos))
    }
}

impl Add<Duration> for Time {
    type Output = Self;

    fn add(self, duration: Duration) -> Self {
        Self(self.0.saturating_add(u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)))
    }
}

impl Sub<Duration> for Time {
    type Output = Self;

    fn sub(self, duration: Duration) -> Self {
        Self(self.0.saturating_sub(u64::try_from(duration.as_nanos()).unwrap_or(u64::MAX)))
    }
}

impl fmt::Debug for Time {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{}.{:09}s", self.0 / 1_000_000_000, self.0 % 1_000_000_000)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn arithmetic_saturates_at_both_ends() {
        assert_eq!(Time::ZERO - Duration::from_secs(1), Time::ZERO);
        assert_eq!(Time::MAX + Duration::from_secs(1), Time::MAX);
        assert_eq!(Time::from_nanos(5).since(Time::from_nanos(9)), Duration::ZERO);
        assert_eq!(Time::from_nanos(5).shifted(-9), Time::ZERO);
    }
}
