//! Delayed wake of the drain task, without a switch to its thread now: the sender of a burst has its next
//! message ready earlier than that.

use std::{
    io,
    os::fd::OwnedFd,
    task::{Context, Poll},
    thread::{self, ThreadId},
};

use rustix::time::{Itimerspec, TimerfdTimerFlags, Timespec, timerfd_settime};
use sinew_runtime::timer::kernel_timer;
use tokio::{io::unix::AsyncFd, runtime::Handle};

/// Delay in nanoseconds that lets more delayable messages arrive. Waking a thread on an idle CPU takes about
/// half of it, and so does a write of 32 KiB.
const WAKE_DELAY_NS: i64 = 50_000;

thread_local! {
    /// The calling thread: the standard library counts a reference for each question.
    static THREAD: ThreadId = thread::current().id();
}

/// The delayed wake of a connection's drain task.
#[derive(Debug, Default)]
pub(super) struct DelayedWake {
    /// The timer, created by the drain task at the first burst: only that thread has the reactor.
    timer: Option<Timer>,
    is_wanted: bool,
}

#[derive(Debug)]
struct Timer {
    timer: AsyncFd<OwnedFd>,
    is_set: bool,
    /// The thread of the drain task. A sender on this thread needs no timer, because the drain task runs when
    /// the sender's task ends.
    drainer: ThreadId,
}

impl DelayedWake {
    /// Schedules a delayed wake of the drain task. Returns whether it is scheduled.
    pub(super) fn wake_later(&mut self) -> bool {
        match &mut self.timer {
            Some(timer) => timer.wake_later(),
            None => {
                self.is_wanted = true;
                false
            }
        }
    }

    /// Registers the awake drain task for the next wake.
    pub(super) fn poll(&mut self, cx: &mut Context<'_>) {
        if std::mem::take(&mut self.is_wanted) && Handle::try_current().is_ok() {
            // Without a timer, the drain task is woken at once each time.
            self.timer = Timer::new().ok();
        }
        if let Some(timer) = &mut self.timer {
            timer.poll(cx);
        }
    }
}

impl Timer {
    fn new() -> io::Result<Self> {
        Ok(Self { timer: kernel_timer()?, is_set: false, drainer: THREAD.with(|thread| *thread) })
    }

    fn wake_later(&mut self) -> bool {
        if THREAD.with(|thread| *thread == self.drainer) {
            return false;
        }
        if !self.is_set {
            let never = Timespec { tv_sec: 0, tv_nsec: 0 };
            let setting =
                Itimerspec { it_interval: never, it_value: Timespec { tv_sec: 0, tv_nsec: WAKE_DELAY_NS } };
            self.is_set = timerfd_settime(self.timer.get_ref(), TimerfdTimerFlags::empty(), &setting).is_ok();
        }
        self.is_set
    }

    fn poll(&mut self, cx: &mut Context<'_>) {
        // The timer is not read: setting it again clears its expirations.
        while let Poll::Ready(ready) = self.timer.poll_read_ready(cx) {
            self.is_set = false;
            match ready {
                Ok(mut ready) => ready.clear_ready(),
                Err(_) => return,
            }
        }
    }
}
