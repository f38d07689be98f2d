//! The deadline of an output on a virtual clock: the clock itself makes the output safe, as no time passes
//! meanwhile.

use std::{
    sync::{Arc, Weak, atomic::Ordering},
    task::{Wake, Waker},
};

use super::{CheckResult, LogEntry, Shared, WatchedOutput, wake};
use crate::time::Time;

impl<O> Shared<O> {
    /// Publishes when the output must be checked, in nanoseconds; `u64::MAX`: never.
    pub(super) fn set_deadline(&self, deadline: u64) {
        self.watch.deadline.store(deadline, Ordering::Release);
        if let Some(wake_up) = &self.wake_up {
            // A trip meanwhile is not replaced by the former deadline.
            let is_tripped = self.watch.is_tripped.load(Ordering::Acquire);
            let deadline = (deadline != u64::MAX).then(|| Time::from_nanos(deadline));
            wake_up.set(if is_tripped { Some(Time::ZERO) } else { deadline });
        }
    }

    /// Has the output checked as soon as its lock is free: by the thread `safe-output`, or at the next move
    /// of a virtual clock.
    pub(super) fn check_soon(&self) {
        match &self.wake_up {
            Some(wake_up) => wake_up.set(Some(Time::ZERO)),
            None => wake(),
        }
    }
}

struct VirtualDeadline<O>(Weak<Shared<O>>);

/// Returns the waker that checks this output, if it still exists.
pub(super) fn waker<O: Send + 'static>(output: Weak<Shared<O>>) -> Waker {
    Waker::from(Arc::new(VirtualDeadline(output)))
}

impl<O: Send + 'static> Wake for VirtualDeadline<O> {
    fn wake(self: Arc<Self>) {
        let Some(output) = self.0.upgrade() else { return };
        match output.try_expire() {
            // The holder of the lock sets the next deadline.
            CheckResult::Locked => {}
            CheckResult::Done(entry) => entry.into_iter().for_each(LogEntry::log),
        }
    }
}
