//! Looking before sleeping: the IO thread stays awake for a while after a peer's message, so that the next one need not wake
//! a core that has gone idle.

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
    /// After each message for so long; not at all if that is zero.
    pub(super) fn new(within: Duration) -> Self {
        Self { within, until: AtomicU64::new(0), begins: Notify::new() }
    }

    /// A message came.
    pub(super) fn heard(&self, now: Time) {
        if self.within.is_zero() {
            return;
        }
        if self.until.swap((now + self.within).as_nanos(), Ordering::Relaxed) <= now.as_nanos() {
            self.begins.notify_one();
        }
    }

    /// Keeps the thread that polls this awake as long as that is wanted, and lets everybody else on it have their turn: each
    /// turn asks the kernel what has come, and does not wait for it.
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

    /// Polls the future once, and says whether it wants to be polled again at once.
    fn looks_again(future: &mut Pin<&mut impl Future<Output = ()>>) -> bool {
        let woken = Arc::new(Woken::default());
        assert!(future.as_mut().poll(&mut Context::from_waker(&woken.clone().into())).is_pending());
        woken.0.load(Ordering::Relaxed)
    }

    #[test]
    fn the_thread_looks_again_only_after_a_message_and_only_as_long_as_is_wanted() {
        let spin = Spin::new(Duration::from_secs(60));
        let mut awake = pin!(spin.keep_awake());
        assert!(!looks_again(&mut awake), "nothing came");
        spin.heard(Time::now());
        assert!(looks_again(&mut awake) && looks_again(&mut awake), "a message came");
        spin.until.store(0, Ordering::Relaxed);
        assert!(!looks_again(&mut awake), "the time is over");
        spin.heard(Time::now());
        assert!(looks_again(&mut awake), "another message came");
    }

    #[test]
    fn without_a_time_nobody_is_kept_awake() {
        let spin = Spin::new(Duration::ZERO);
        let mut awake = pin!(spin.keep_awake());
        spin.heard(Time::now());
        assert!(!looks_again(&mut awake));
    }
}
