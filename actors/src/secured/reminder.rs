//! When it is said again that a certificate ends. Pure.

use std::time::Duration;

use sinew_runtime::time::Time;

const HOUR: Duration = Duration::from_secs(3_600);
const DAY: Duration = Duration::from_secs(24 * 3_600);

/// What there is to be said again.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Matter {
    /// It is not over yet.
    EndsSoon,
    HasEnded,
}

/// When it was said last. It outlives the layer that says it.
#[derive(Debug)]
pub(super) struct Reminder {
    last: Time,
}

impl Reminder {
    /// It is said at the start, which is now.
    pub(super) const fn new(now: Time) -> Self {
        Self { last: now }
    }

    /// Whether it is to be said again at `now`: then that is when it was said last.
    pub(super) fn is_due(&mut self, matter: Matter, now: Time) -> bool {
        let each = match matter {
            Matter::EndsSoon => DAY,
            Matter::HasEnded => HOUR,
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
    fn what_ends_soon_is_said_each_day_and_what_has_ended_each_hour_whoever_asks_how_often() {
        let begun = Time::from_nanos(1_000_000_000);
        let mut reminder = Reminder::new(begun);
        let minutes = (1..=3 * 24 * 60).map(|minute| begun + Duration::from_secs(60) * minute);
        let said = minutes.filter(|now| reminder.is_due(Matter::EndsSoon, *now)).count();
        assert_eq!(said, 3);
        let later = (1..=5 * 60).map(|minute| begun + 3 * DAY + Duration::from_secs(60) * minute);
        assert_eq!(later.filter(|now| reminder.is_due(Matter::HasEnded, *now)).count(), 5);
    }
}
