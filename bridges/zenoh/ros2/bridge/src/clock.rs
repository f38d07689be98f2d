//! The clocks of the host.

use std::time::{Duration, SystemTime, UNIX_EPOCH};

use sinew::Time;

/// Returns the monotonic clock of the host, which nodes use, too.
pub(crate) fn now() -> Duration {
    Duration::from_nanos(Time::now().as_nanos())
}

/// Returns the wall clock of the host, in nanoseconds.
#[expect(
    clippy::disallowed_methods,
    reason = "ROS 2 stamps messages with the wall clock, and no wait depends on it"
)]
pub(crate) fn wall_ns() -> i64 {
    let since = SystemTime::now().duration_since(UNIX_EPOCH).unwrap_or_default();
    i64::try_from(since.as_nanos()).unwrap_or(i64::MAX)
}
