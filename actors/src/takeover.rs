//! Who waits for news after a layer was restarted: the present life of it, and no former one.

use tokio::sync::Notify;

/// The caller alone waits for `news` from now on. A loop that outlives its thread begins with this, before it looks for the first time.
///
/// A layer that hangs is restarted on a new thread, and what waited on the old one goes on waiting there: it would be told first, and nobody
/// looks. Those are told now, all at once. What is told from then on, and what nobody was told yet, is kept for the caller.
pub(crate) fn take_over(news: &Notify) {
    news.notify_waiters();
}

#[cfg(test)]
pub(crate) mod tests {
    use std::{
        pin::{Pin, pin},
        sync::{
            Arc,
            atomic::{AtomicBool, Ordering},
        },
        task::{Context, Wake},
    };

    use super::*;

    /// Whether a future that waits was woken.
    #[derive(Debug, Default)]
    pub(crate) struct Woken(AtomicBool);

    impl Woken {
        pub(crate) fn is(&self) -> bool {
            self.0.load(Ordering::Relaxed)
        }
    }

    impl Wake for Woken {
        fn wake(self: Arc<Self>) {
            self.0.store(true, Ordering::Relaxed);
        }
    }

    /// Polls a future once, which waits then.
    pub(crate) fn waits<T>(future: Pin<&mut impl Future<Output = T>>) -> Arc<Woken> {
        let woken = Arc::<Woken>::default();
        assert!(future.poll(&mut Context::from_waker(&woken.clone().into())).is_pending(), "it waits");
        assert!(!woken.is(), "it waits");
        woken
    }

    #[test]
    fn who_takes_over_is_told_and_not_who_waited_before() {
        let news = Notify::new();
        let mut former = pin!(news.notified());
        waits(former.as_mut());
        take_over(&news);
        let mut present = pin!(news.notified());
        let woken = waits(present.as_mut());
        news.notify_one();
        assert!(woken.is());
    }

    #[test]
    fn what_nobody_was_told_is_kept_for_who_takes_over() {
        let news = Notify::new();
        news.notify_one();
        take_over(&news);
        let mut present = pin!(news.notified());
        assert!(futures_util::FutureExt::now_or_never(present.as_mut()).is_some());
        waits(pin!(news.notified()));
    }
}
