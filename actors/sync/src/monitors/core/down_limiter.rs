//! Rate limit for reports of a missing application: a burst, then one at a time.

use std::time::Duration;

use sinew_model::rate_limiter::{KeyedRateLimiter, Rate, WhenFull};
use sinew_runtime::{tid::AppAddress, time::Time};

use super::{MISSING_INTERVAL, MONITORS_MAX, PER_WATCHER_MAX};

/// Maximum number of watchers with a rate of their own: a node has 4,096 clients at most, and applications of
/// its own.
const WATCHERS_MAX: usize = 2 * MONITORS_MAX;

/// The limit of each watcher: [`PER_WATCHER_MAX`] reports at once, and one more each [`MISSING_INTERVAL`].
#[derive(Debug)]
pub(super) struct DownLimiter(KeyedRateLimiter<AppAddress>);

impl DownLimiter {
    pub(super) const fn new() -> Self {
        let rate = Rate::new(MISSING_INTERVAL, PER_WATCHER_MAX as u32);
        Self(KeyedRateLimiter::new(rate, WATCHERS_MAX, WhenFull::Share))
    }

    /// Counts one report to this watcher. Returns the time at which it may be sent, or `None` if that is now.
    pub(super) fn next(&mut self, watcher: AppAddress, now: Time) -> Option<Time> {
        let limiter = self.0.of(&watcher, now);
        let delay = limiter.delay(now);
        limiter.charge(now, MISSING_INTERVAL, Duration::MAX);
        (!delay.is_zero()).then(|| now + delay)
    }

    /// Resets the limit of a watcher that has ended.
    pub(super) fn forget(&mut self, watcher: AppAddress) {
        self.0.remove(&watcher);
    }
}
