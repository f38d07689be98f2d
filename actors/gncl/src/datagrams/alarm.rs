//! The alarm of all peers' channels: the time of the earliest action that is due.

use std::{
    sync::atomic::{AtomicU64, Ordering},
    time::Duration,
};

use sinew_model::notifications::claim_notifications;
use sinew_runtime::time::Time;
use tokio::{sync::Notify, time::timeout};

/// An alarm within this time of a turn of the reader is set anew. The alarm of an acknowledgement, 1.5 ms after
/// a value, is so at the next value of a 1 kHz loop, and not at values of other peers shortly before.
const SOON: Duration = Duration::from_micros(750);

/// Wakes the task of the timer for an action that is due earlier.
#[derive(Debug, Default)]
pub(crate) struct Alarm {
    /// Time of the next check, in nanoseconds.
    set: AtomicU64,
    earlier: Notify,
}

impl Alarm {
    /// Registers an action that is due at this time.
    pub(crate) fn set(&self, due: Option<Time>) {
        let Some(due) = due.map(Time::as_nanos) else { return };
        // SYNC: the checking task first stores the maximum, and only then checks. A due time registered
        // meanwhile is earlier than that.
        if due < self.set.load(Ordering::Acquire) && due < self.set.fetch_min(due, Ordering::AcqRel) {
            self.earlier.notify_one();
        }
    }

    /// Has an alarm that is near set anew, after a turn of the IO thread. Its reason may have gone meanwhile:
    /// an acknowledgement went with a value, or one came. This costs no system call; a wake of the thread that
    /// finds nothing due does.
    pub(crate) fn review(&self, now: Time) {
        // SYNC: Relaxed; only this thread stores a later time.
        if self.set.load(Ordering::Relaxed) < (now + SOON).as_nanos() {
            self.earlier.notify_one();
        }
    }

    /// Makes the calling task the only one that is notified from now on.
    pub(crate) fn claim(&self) {
        claim_notifications(&self.earlier);
    }

    /// Forgets the registered time. The caller checks all channels next, and waits until the earliest due time.
    pub(crate) fn clear(&self) {
        self.set.store(u64::MAX, Ordering::Release);
    }

    /// Waits until this time, or for [`set`](Self::set) or [`review`](Self::review).
    pub(crate) async fn reached(&self, due: Option<Time>) {
        match due {
            None => self.earlier.notified().await,
            Some(due) => {
                self.set.fetch_min(due.as_nanos(), Ordering::AcqRel);
                // The check runs after an earlier due time as well as after the timeout.
                drop(timeout(due.since(Time::now()), self.earlier.notified()).await);
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::pin::pin;

    use super::*;
    use sinew_model::notifications::testing::waits;

    #[test]
    fn turn_of_the_reader_reviews_only_a_near_alarm() {
        let (alarm, now) = (Alarm::default(), Time::now());
        alarm.set.store((now + 2 * SOON).as_nanos(), Ordering::Relaxed);
        let mut earlier = pin!(alarm.earlier.notified());
        let woken = waits(earlier.as_mut());
        alarm.review(now);
        assert!(!woken.is(), "its reason is still to come");
        alarm.review(now + SOON + Duration::from_nanos(1));
        assert!(woken.is());
    }
}
