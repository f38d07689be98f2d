//! Periodic checks that run only while there is something to check: a node at rest is not woken needlessly.

use std::{
    sync::atomic::{AtomicBool, Ordering},
    time::Duration,
};

use tokio::{sync::Notify, time::sleep};

use crate::notifications::claim_notifications;

/// Whether the checking task runs, and the notification that starts it.
#[derive(Debug, Default)]
pub struct PeriodicChecks {
    run: AtomicBool,
    wanted: Notify,
}

impl PeriodicChecks {
    /// Requests checks. The caller has added the item before, and has released the lock that protects it.
    pub fn request(&self) {
        // SYNC: a task that finds nothing clears the flag before it checks again under that lock. It has seen
        // items added before, or this call sees the cleared flag.
        if !self.run.load(Ordering::Relaxed) && !self.run.swap(true, Ordering::AcqRel) {
            self.wanted.notify_one();
        }
    }

    /// Checks every `period` while `check` returns that there is something, and starts again when it is requested.
    pub async fn run(&self, period: Duration, mut check: impl FnMut() -> bool) {
        claim_notifications(&self.wanted);
        // A former instance of the layer may have been about to check.
        self.run.store(true, Ordering::Release);
        loop {
            sleep(period).await;
            if check() {
                continue;
            }
            self.run.store(false, Ordering::Release);
            if check() {
                self.run.store(true, Ordering::Release);
            } else {
                self.wanted.notified().await;
            }
        }
    }
}
