//! Periodic checks that run only while there is something to check: a node at rest is not woken needlessly.

use std::{
    pin::pin,
    sync::atomic::{AtomicU64, Ordering},
    time::Duration,
};

use tokio::{sync::Notify, time::sleep};

use crate::notifications::claim_notifications;

/// The bit of the state that is set while the checking task runs. The other bits are the number of that task.
const RUNS: u64 = 1;

/// Whether the checking task runs, and the notification that starts it.
#[derive(Debug, Default)]
pub struct PeriodicChecks {
    /// Twice the number of the current call of [`run`](Self::run), and [`RUNS`].
    state: AtomicU64,
    wanted: Notify,
}

impl PeriodicChecks {
    /// Requests checks. The caller has added the item before, and has released the lock that protects it.
    pub fn request(&self) {
        // SYNC: a task that finds nothing clears the flag before it checks again under that lock. It has seen
        // items added before, or this call sees the cleared flag.
        let runs = |state: u64| state & RUNS != 0;
        if !runs(self.state.load(Ordering::Relaxed)) && !runs(self.state.fetch_or(RUNS, Ordering::AcqRel)) {
            self.wanted.notify_one();
        }
    }

    /// Checks every `period` while `check` returns that there is something, and starts again when it is requested. A
    /// later call takes the place of an earlier one, which then neither checks nor ends.
    pub async fn run(&self, period: Duration, mut check: impl FnMut() -> bool) {
        let task = self.begin();
        claim_notifications(&self.wanted);
        loop {
            sleep(period).await;
            if !self.is_current(task) {
                break;
            }
            if check() {
                continue;
            }
            // From here on `check` may have hung, and the layer may have a new instance.
            if !self.set_runs(task, false) {
                break;
            }
            // Created before the current task is compared, so that a later task claims it.
            let wanted = pin!(self.wanted.notified());
            if check() {
                self.set_runs(task, true);
            } else if self.is_current(task) {
                wanted.await;
            }
        }
        std::future::pending().await
    }

    /// Makes the caller the current task, which runs. Returns its number.
    fn begin(&self) -> u64 {
        let task = (self.state.fetch_add(2, Ordering::AcqRel) >> 1) + 1;
        self.state.fetch_or(RUNS, Ordering::AcqRel);
        task
    }

    fn is_current(&self, task: u64) -> bool {
        self.state.load(Ordering::Acquire) >> 1 == task
    }

    /// Sets whether this task runs. Returns `false` if it is not the current one.
    fn set_runs(&self, task: u64, runs: bool) -> bool {
        let next = (task << 1) | if runs { RUNS } else { 0 };
        let set = |state: u64| (state >> 1 == task).then_some(next);
        self.state.fetch_update(Ordering::AcqRel, Ordering::Relaxed, set).is_ok()
    }
}

#[cfg(test)]
mod tests {
    use std::{
        cell::Cell,
        pin::Pin,
        sync::{Arc, mpsc::sync_channel},
    };

    use tokio::{runtime::Builder, time::timeout};

    use super::*;
    use crate::notifications::testing::waits;

    const PERIOD: Duration = Duration::from_millis(1);
    /// No test waits longer than this for an event.
    const DEADLINE: Duration = Duration::from_secs(60);

    fn block_on<T>(test: impl Future<Output = T>) -> T {
        let runtime = Builder::new_current_thread().enable_time().build().expect("a runtime");
        runtime.block_on(test)
    }

    /// Polls the checks until so many were made.
    async fn poll_until(mut run: Pin<&mut impl Future<Output = ()>>, made: &Cell<u32>, count: u32) {
        while made.get() < count {
            timeout(PERIOD, run.as_mut()).await.expect_err("it never ends");
        }
    }

    /// A layer hangs in its second check, after the flag was cleared, and has a new instance when it resumes.
    #[test]
    fn former_instance_that_resumes_takes_no_request() {
        for finds_something in [true, false] {
            let checks = Arc::<PeriodicChecks>::default();
            let (hangs, hung) = sync_channel(1);
            let (resume, resumed) = sync_channel::<()>(1);
            let (waits_again, waited) = sync_channel(1);
            let (end, ended) = sync_channel::<()>(1);
            let of_former = checks.clone();
            let former = std::thread::spawn(move || {
                block_on(async {
                    let made = Cell::new(0);
                    let mut run = pin!(of_former.run(PERIOD, || {
                        made.set(made.get() + 1);
                        if made.get() == 2 {
                            hangs.send(()).expect("it is waited for");
                            resumed.recv_timeout(DEADLINE).expect("it resumes");
                        }
                        made.get() == 2 && finds_something
                    }));
                    poll_until(run.as_mut(), &made, 2).await;
                    waits_again.send(()).expect("it is waited for");
                    // Its future exists until the test ends. An error means that the test has failed.
                    let _ = ended.recv_timeout(DEADLINE);
                });
            });
            hung.recv_timeout(DEADLINE).expect("the former instance hangs");
            block_on(async {
                let made = Cell::new(0);
                let mut run = pin!(checks.run(PERIOD, || {
                    made.set(made.get() + 1);
                    false
                }));
                poll_until(run.as_mut(), &made, 2).await;
                resume.send(()).expect("it is waited for");
                waited.recv_timeout(DEADLINE).expect("the former instance waits");
                for count in [4, 6] {
                    let woken = waits(run.as_mut());
                    checks.request();
                    assert!(woken.is(), "before check {count}, with {finds_something}");
                    poll_until(run.as_mut(), &made, count).await;
                }
            });
            end.send(()).expect("it is waited for");
            former.join().expect("the former instance does not panic");
        }
    }
}
