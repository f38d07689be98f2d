//! Looks at what has a time, only as long as there is something: a node at rest is not woken for nothing.

use std::{
    sync::atomic::{AtomicBool, Ordering},
    time::Duration,
};

use tokio::{sync::Notify, time::sleep};

use crate::takeover::take_over;

/// Whether somebody looks, and how to have him look.
#[derive(Debug, Default)]
pub(super) struct Ticks {
    run: AtomicBool,
    wanted: Notify,
}

impl Ticks {
    /// There is something to look at from now on. Said after it is there, and after the lock that it stands under is free.
    pub(super) fn want(&self) {
        // SYNC: whoever finds nothing says so before he looks again under that lock: he has seen what was put there before, or this sees
        // what he said.
        if !self.run.load(Ordering::Relaxed) && !self.run.swap(true, Ordering::AcqRel) {
            self.wanted.notify_one();
        }
    }

    /// Looks every `period` as long as `look` says that there is something, at once again when there is.
    pub(super) async fn run(&self, period: Duration, mut look: impl FnMut() -> bool) {
        take_over(&self.wanted);
        // A former life of the layer may have been about to look.
        self.run.store(true, Ordering::Release);
        loop {
            sleep(period).await;
            if look() {
                continue;
            }
            self.run.store(false, Ordering::Release);
            if look() {
                self.run.store(true, Ordering::Release);
            } else {
                self.wanted.notified().await;
            }
        }
    }
}
