//! The timer of GNCL's core: one of the kernel's. The reactor's own sleep would wake the thread up to three times for
//! one of a second, because its wheel has slots of 64 ms.

use std::{cell::Cell, future::poll_fn, rc::Rc, task::Poll};

use actix::{Context, StreamHandler};
use futures_util::{Stream, stream};
use sinew_runtime::{alarm::Alarm, time::Time};
use tokio::sync::Notify;

use super::Gncl;
use crate::core::Input;

/// The timer has fired.
pub(super) struct TimerFired;

/// When the core needs the passing of time.
#[derive(Debug, Default)]
pub(super) struct CoreTimer {
    due: Cell<Option<Time>>,
    earlier: Notify,
}

impl CoreTimer {
    /// Sets the timer for `at`. No effect if it fires earlier: it is set again then.
    pub(super) fn set(&self, at: Time) {
        if self.due.get().is_none_or(|due| at < due) {
            self.due.set(Some(at));
            self.earlier.notify_one();
        }
    }

    /// Returns the events of the timer, which must be set again after each.
    pub(super) fn events(self: Rc<Self>) -> impl Stream<Item = TimerFired> {
        // Without a descriptor for it the reactor's sleep serves.
        stream::unfold(Alarm::new().ok(), move |mut alarm| {
            let timer = self.clone();
            async move {
                timer.fired(&mut alarm).await;
                Some((TimerFired, alarm))
            }
        })
    }

    async fn fired(&self, alarm: &mut Option<Alarm>) {
        loop {
            tokio::select! {
                () = reached(alarm, self.due.get()) => return self.due.set(None),
                () = self.earlier.notified() => {}
            }
        }
    }
}

/// Waits until this time. With `None` it never ends.
async fn reached(alarm: &mut Option<Alarm>, due: Option<Time>) {
    match (alarm, due) {
        (_, None) => std::future::pending().await,
        (None, Some(due)) => tokio::time::sleep(due.since(Time::now())).await,
        (Some(alarm), Some(due)) => {
            poll_fn(|context| {
                if Time::now() >= due {
                    return Poll::Ready(());
                }
                alarm.wake_at(Some(due), context).expect("a timer that was made takes a time");
                Poll::Pending
            })
            .await;
        }
    }
}

impl StreamHandler<TimerFired> for Gncl {
    fn handle(&mut self, _: TimerFired, ctx: &mut Context<Self>) {
        self.input(Input::TimePassed, ctx);
    }
}

#[cfg(test)]
mod tests {
    use std::{pin::pin, time::Duration};

    use tokio::{runtime::Builder, time::timeout};

    use super::*;

    const LONG: Duration = Duration::from_secs(3_600);

    /// Runs a test with a timer of the kernel's, and with the reactor's.
    fn run(test: impl AsyncFn(Option<Alarm>)) {
        let runtime = Builder::new_current_thread().enable_all().build().expect("a reactor");
        let both = async {
            test(Some(Alarm::new().expect("a descriptor"))).await;
            test(None).await;
        };
        let ended = runtime.block_on(async { timeout(Duration::from_secs(60), both).await });
        ended.expect("waited 60 s for the timer");
    }

    #[test]
    fn timer_fires_at_earliest_time_and_is_set_again() {
        run(async |mut alarm| {
            let timer = CoreTimer::default();
            timer.set(Time::now() + LONG);
            let due = Time::now() + Duration::from_millis(20);
            timer.set(due);
            timer.set(due + LONG);
            timer.fired(&mut alarm).await;
            assert!(Time::now() >= due);
            timer.set(Time::now());
            timer.fired(&mut alarm).await;
        });
    }

    #[test]
    fn earlier_time_replaces_one_that_is_waited_for() {
        run(async |mut alarm| {
            let timer = CoreTimer::default();
            timer.set(Time::now() + LONG);
            let mut fired = pin!(timer.fired(&mut alarm));
            let early = timeout(Duration::from_millis(5), fired.as_mut()).await;
            early.expect_err("its time has not come");
            timer.set(Time::now());
            fired.await;
        });
    }
}
