//! The times of repeated warnings about the end of a certificate. Pure.

use std::time::Duration;

use sinew_runtime::time::Time;

const HOUR: Duration = Duration::from_secs(3_600);
const DAY: Duration = Duration::from_secs(24 * 3_600);

/// The subject of a repeated reminder.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Expiry {
    /// It is not over yet.
    EndsSoon,
    HasEnded,
}

/// The time of the last warning. It outlives the layer that logs it.
#[derive(Debug)]
pub(super) struct Reminder {
    last: Time,
}

impl Reminder {
    /// The first warning is logged at the start, which is now.
    pub(super) const fn new(now: Time) -> Self {
        Self { last: now }
    }

    /// Returns whether the warning is due at `now`, and then records it.
    pub(super) fn is_due(&mut self, expiry: Expiry, now: Time) -> bool {
        let each = match expiry {
            Expiry::EndsSoon => DAY,
            Expiry::HasEnded => HOUR,
        };
        let is_due = now.since(self.last) >= each;
        if is_due {
            self.last = now;
        }
        is_due
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn expiring_reminds_daily_and_expired_hourly() {
        let begun = Time::from_nanos(1_000_000_000);
        let mut reminder = Reminder::new(begun);
        let minutes = (1..=3 * 24 * 60).map(|minute| begun + Duration::from_secs(60) * minute);
        let count = minutes.filter(|now| reminder.is_due(Expiry::EndsSoon, *now)).count();
        assert_eq!(count, 3);
        let later = (1..=5 * 60).map(|minute| begun + 3 * DAY + Duration::from_secs(60) * minute);
        assert_eq!(later.filter(|now| reminder.is_due(Expiry::HasEnded, *now)).count(), 5);
    }
}
