//! Time to hear what waits for this node before it judges others by it: it was late itself.
//!
//! Who gets no processor, or whose host sleeps, finds all its deadlines over when it goes on, and what would have kept them still in its post and
//! in its sockets. So nothing is over until that has been read, or has had the time to be.

use std::time::Duration;

use sinew_runtime::time::Time;

use super::Core;

/// How late the sync manager's own timer may be without anything to it: less than a fifth of the shortest wait that is judged by it.
pub(super) const LATE: Duration = Duration::from_millis(10);
/// How long a respite lasts at most; a shorter lateness makes one as short.
pub(super) const RESPITE_MAX: Duration = Duration::from_millis(50);

/// Respites in a row at most: a timer that is always late puts nothing off for ever.
pub(super) const IN_A_ROW_MAX: u32 = 3;

/// The last respite.
#[derive(Debug, Default)]
pub(super) struct Respite {
    until: Option<Time>,
    in_a_row: u32,
    /// Something that has come is not read yet, and what is over has not been so for longer than [`LATE`].
    is_reading: bool,
}

/// A time, and that by which waits are judged.
#[derive(Clone, Copy, Debug)]
pub(super) struct Moment {
    pub(super) now: Time,
    /// Now; or before all deadlines, in a respite. // spec: SYNC-16
    pub(super) judged: Time,
}

impl Respite {
    /// Something has happened here at last that was to be at `due`, and so many events wait.
    fn woken(&mut self, now: Time, due: Time, unread: usize) {
        let late = now.since(due);
        self.is_reading = false;
        if self.lasts(now) {
            return;
        }
        if self.in_a_row == IN_A_ROW_MAX {
            self.in_a_row = 0;
        } else if late > LATE {
            self.until = Some(now + late.min(RESPITE_MAX));
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

    /// When what is over at `at` can be judged.
    pub(super) fn judges(&self, at: Time) -> Time {
        self.until.map_or(at, |until| at.max(until))
    }
}

impl Core {
    /// The shell runs, whatever for, and `unread` events wait behind this one: said before each input, so that it is known how late it is for what
    /// was to be done before.
    pub(crate) fn woken(&mut self, now: Time, unread: usize) {
        if let Some(due) = self.next_wake() {
            self.respite.woken(now, due, unread);
        }
    }
}
