//! Polling before sleeping: the IO thread stays awake for a while after a peer's message, so that the next
//! one need not wake an idle core.

use std::{
    sync::atomic::{AtomicU64, Ordering},
    time::Duration,
};

use sinew_runtime::time::Time;
use tokio::sync::Notify;

/// Whether the IO thread stays awake, and until when.
#[derive(Debug, Default)]
pub(super) struct Spin {
    within: Duration,
    /// When it may sleep, in nanoseconds. SYNC: Relaxed; it belongs to one thread.
    until: AtomicU64,
    begins: Notify,
}

impl Spin {
    /// Creates a spin of this length after each message; zero disables it.
    pub(super) fn new(within: Duration) -> Self {
        Self { within, until: AtomicU64::new(0), begins: Notify::new() }
    }

    /// Records a received message.
    pub(super) fn on_message(&self, now: Time) {
        if self.within.is_zero() {
            return;
        }
        if self.until.swap((now + self.within).as_nanos(), Ordering::Relaxed) <= now.as_nanos() {
            self.begins.notify_one();
        }
    }

    /// Keeps the polling thread awake as long as required, and yields to its other tasks. Each turn checks
    /// the kernel for events without waiting.
    pub(super) async fn keep_awake(&self) {
        loop {
            self.begins.notified().await;
            while Time::now().as_nanos() < self.until.load(Ordering::Relaxed) {
                tokio::task::yield_now().await;
            }
        }
    }
}

#[cfg(test)]
mod tests {
    use std::{
        pin::{Pin, pin},
        sync::{Arc, atomic::AtomicBool},
        task::{Context, Wake},
    };

    use super::*;

    #[derive(Default)]
    struct Woken(AtomicBool);

    impl Wake for Woken {
        fn wake(self: Arc<Self>) {
            self.0.store(true, Ordering::Relaxed);
        }
    }

    /// Polls the future once. Returns whether it requests another poll at once.
    fn looks_again(future: &mut Pin<&mut impl Future<Output = ()>>) -> bool {
        let woken = Arc::new(Woken::default());
        assert!(future.as_mut().poll(&mut Context::from_waker(&woken.clone().into())).is_pending());
        woken.0.load(Ordering::Relaxed)
    }

    #[test]
    fn thread_polls_for_its_time_after_a_message() {
        let spin = Spin::new(Duration::from_secs(60));
        let mut awake = pin!(spin.keep_awake());
        assert!(!looks_again(&mut awake), "nothing came");
        spin.on_message(Time::now());
        assert!(looks_again(&mut awake) && looks_again(&mut awake), "a message came");
        spin.until.store(0, Ordering::Relaxed);
        assert!(!looks_again(&mut awake), "the time is over");
        spin.on_message(Time::now());
        assert!(looks_again(&mut awake), "another message came");
    }

    #[test]
    fn zero_time_keeps_no_thread_awake() {
        let spin = Spin::new(Duration::ZERO);
        let mut awake = pin!(spin.keep_awake());
        spin.on_message(Time::now());
        assert!(!looks_again(&mut awake));
    }
}
