//! Grace periods: after this node was late itself, it reads its pending input before it judges deadlines.
//!
//! After a scheduling delay or a suspend of the host, all deadlines of this node have passed. The input that
//! would have met them is still in its event queue and its sockets. No wait therefore expires until that
//! input has been read, or there was time to read it.

use std::time::Duration;

use sinew_runtime::time::Time;

/// Maximum delay of the sync manager's timer that counts as normal. It is less than a fifth of the shortest
/// wait that the timer judges.
pub(super) const LATE: Duration = Duration::from_millis(10);
/// Maximum duration of a grace period. After a shorter delay the period is as long as the delay.
pub(super) const GRACE_PERIOD_MAX: Duration = Duration::from_millis(50);

/// Maximum number of consecutive grace periods. A timer that is always late must not postpone deadlines
/// forever.
pub(super) const IN_A_ROW_MAX: u32 = 3;

/// The state of the current grace period.
#[derive(Debug, Default)]
pub(super) struct GracePeriod {
    until: Option<Time>,
    in_a_row: u32,
    /// Pending input is not read yet, and the expired deadline is at most [`LATE`] old.
    is_reading: bool,
}

/// The current time, and the time by which waits are judged.
#[derive(Clone, Copy, Debug)]
pub(super) struct Moment {
    pub(super) now: Time,
    /// `now`, or before all deadlines during a grace period. // spec: SYNC-16
    pub(super) judged: Time,
}

impl GracePeriod {
    /// Updates the grace period when the shell runs. `due` is the time of the earliest pending deadline,
    /// `unread` the number of queued events.
    pub(super) fn woken(&mut self, now: Time, due: Time, unread: usize) {
        let late = now.since(due);
        self.is_reading = false;
        if self.lasts(now) {
            return;
        }
        if self.in_a_row == IN_A_ROW_MAX {
            self.in_a_row = 0;
        } else if late > LATE {
            self.until = Some(now + late.min(GRACE_PERIOD_MAX));
            self.in_a_row += 1;
        } else if unread > 0 {
            self.is_reading = true;
        } else {
            self.in_a_row = 0;
        }
    }

    fn lasts(&self, now: Time) -> bool {
        self.until.is_some_and(|until| now < until)
    }

    pub(super) fn moment(&self, now: Time) -> Moment {
        Moment { now, judged: if self.is_reading || self.lasts(now) { Time::ZERO } else { now } }
    }

    /// Returns the earliest time at which a deadline at `at` can be judged.
    pub(super) fn postponed(&self, at: Time) -> Time {
        self.until.map_or(at, |until| at.max(until))
    }
}
