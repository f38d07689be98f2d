//! Wakes the drainer in a moment, without a switch to its thread now: a flood's sender has the next message ready before that.

use std::{
    io,
    os::fd::OwnedFd,
    task::{Context, Poll},
    thread::{self, ThreadId},
};

use rustix::time::{Itimerspec, TimerfdTimerFlags, Timespec, timerfd_settime};
use sinew_runtime::timer::kernel_timer;
use tokio::{io::unix::AsyncFd, runtime::Handle};

/// How long what is patient waits for more of its sort, in nanoseconds. Waking a thread of a CPU that has gone idle takes about half of
/// that, and a write of 32 KiB as long.
const MOMENT_NS: i64 = 50_000;

/// Who wakes the drainer of a connection later.
#[derive(Debug, Default)]
pub(super) struct Rouser {
    /// Made by the drainer when the first flood has come: only that thread has the reactor.
    timer: Option<Timer>,
    is_wanted: bool,
}

#[derive(Debug)]
struct Timer {
    timer: AsyncFd<OwnedFd>,
    is_set: bool,
    /// Where the drainer runs: there it needs no timer, because it has its turn when the sender's is over.
    drainer: ThreadId,
}

impl Rouser {
    /// Has the drainer woken in a moment. Returns whether it will be.
    pub(super) fn rouse_later(&mut self) -> bool {
        match &mut self.timer {
            Some(timer) => timer.rouse_later(),
            None => {
                self.is_wanted = true;
                false
            }
        }
    }

    /// The drainer is awake, and waits for the next time.
    pub(super) fn poll(&mut self, cx: &mut Context<'_>) {
        if std::mem::take(&mut self.is_wanted) && Handle::try_current().is_ok() {
            // Without a timer it is woken at once each time.
            self.timer = Timer::new().ok();
        }
        if let Some(timer) = &mut self.timer {
            timer.poll(cx);
        }
    }
}

impl Timer {
    fn new() -> io::Result<Self> {
        Ok(Self { timer: kernel_timer()?, is_set: false, drainer: thread::current().id() })
    }

    fn rouse_later(&mut self) -> bool {
        if thread::current().id() == self.drainer {
            return false;
        }
        if !self.is_set {
            let never = Timespec { tv_sec: 0, tv_nsec: 0 };
            let setting =
                Itimerspec { it_interval: never, it_value: Timespec { tv_sec: 0, tv_nsec: MOMENT_NS } };
            self.is_set = timerfd_settime(self.timer.get_ref(), TimerfdTimerFlags::empty(), &setting).is_ok();
        }
        self.is_set
    }

    fn poll(&mut self, cx: &mut Context<'_>) {
        // It is not read: setting it anew empties it.
        while let Poll::Ready(ready) = self.timer.poll_read_ready(cx) {
            self.is_set = false;
            match ready {
                Ok(mut ready) => ready.clear_ready(),
                Err(_) => return,
            }
        }
    }
}
