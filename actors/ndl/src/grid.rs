//! Sleeps that share a wake: each ends at a multiple of its period.

use std::time::Duration;

use sinew_runtime::time::Time;

/// Returns the time from `now` to the next multiple of `period`, which is one period at most.
pub(crate) fn until_next(now: Time, period: Duration) -> Duration {
    let period = u64::try_from(period.as_nanos()).unwrap_or(u64::MAX).max(1);
    Duration::from_nanos(period - now.as_nanos() % period)
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn sleeps_of_one_period_end_together(now in 0..u64::MAX / 4, later in 0_u64..1_000_000_000, ms in 1_u64..5_000) {
            let (now, period) = (Time::from_nanos(now), Duration::from_millis(ms));
            let end = now + until_next(now, period);
            prop_assert!(end > now && end.since(now) <= period);
            prop_assert_eq!(end.as_nanos() % (ms * 1_000_000), 0);
            let other = now + Duration::from_nanos(later);
            if other < end {
                prop_assert_eq!(other + until_next(other, period), end);
            }
        }
    }
}
