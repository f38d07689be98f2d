//! Makes the current instance of a restarted layer the only waiter for notifications.

use tokio::sync::Notify;

/// Makes the caller the only waiter for `notify` from now on. A loop that outlives its thread starts with this,
/// before its first check.
///
/// A layer that hangs is restarted on a new thread, and the waiters of the old one remain: they would be
/// notified first, without effect. This function wakes all current waiters. Later notifications, and a
/// pending one, go to the caller.
pub fn claim_notifications(notify: &Notify) {
    notify.notify_waiters();
}

#[cfg(any(test, feature = "testing"))]
#[doc(hidden)]
pub mod testing {
    //! Futures that wait, for tests.

    use std::{
        pin::Pin,
        sync::{
            Arc,
            atomic::{AtomicBool, Ordering},
        },
        task::{Context, Wake},
    };

    /// Whether a future that waits was woken.
    #[derive(Debug, Default)]
    pub struct Woken(AtomicBool);

    impl Woken {
        /// Returns whether it was woken.
        pub fn is(&self) -> bool {
            self.0.load(Ordering::Relaxed)
        }
    }

    impl Wake for Woken {
        fn wake(self: Arc<Self>) {
            self.0.store(true, Ordering::Relaxed);
        }
    }

    /// Polls a future once, which waits then.
    ///
    /// # Panics
    /// If it does not wait.
    pub fn waits<T>(future: Pin<&mut impl Future<Output = T>>) -> Arc<Woken> {
        let woken = Arc::<Woken>::default();
        assert!(future.poll(&mut Context::from_waker(&woken.clone().into())).is_pending(), "it waits");
        assert!(!woken.is(), "it waits");
        woken
    }
}

#[cfg(test)]
mod tests {
    use std::pin::pin;

    use super::{testing::waits, *};

    #[test]
    fn claim_moves_notifications_from_former_waiter() {
        let notify = Notify::new();
        let mut former = pin!(notify.notified());
        waits(former.as_mut());
        claim_notifications(&notify);
        let mut present = pin!(notify.notified());
        let woken = waits(present.as_mut());
        notify.notify_one();
        assert!(woken.is());
    }

    #[test]
    fn pending_notification_is_kept_for_the_claimant() {
        let notify = Notify::new();
        notify.notify_one();
        claim_notifications(&notify);
        let mut present = pin!(notify.notified());
        assert!(futures_util::FutureExt::now_or_never(present.as_mut()).is_some());
        waits(pin!(notify.notified()));
    }
}
