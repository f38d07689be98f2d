//! A task alarm at an exact time: a timerfd of its own, not a timer wheel of milliseconds.

use std::{
    io,
    os::fd::OwnedFd,
    task::{Context, Poll},
};

use rustix::time::{Itimerspec, TimerfdTimerFlags, Timespec, timerfd_settime};
use tokio::io::unix::AsyncFd;

use crate::{time::Time, timer::kernel_timer};

/// One kernel timer, on the monotonic clock.
#[derive(Debug)]
pub struct Alarm {
    timer: AsyncFd<OwnedFd>,
    set_for: Option<Time>,
}

impl Alarm {
    /// Creates a timer that is not set, in the reactor of the calling thread.
    ///
    /// # Errors
    ///
    /// The process has no descriptor left, or the calling thread has no reactor.
    pub fn new() -> io::Result<Self> {
        Ok(Self { timer: kernel_timer()?, set_for: None })
    }

    /// Wakes the task at `at`, or soon if that has passed; never if `at` is `None`.
    ///
    /// # Errors
    ///
    /// The kernel refuses the time.
    pub fn wake_at(&mut self, at: Option<Time>, cx: &mut Context<'_>) -> io::Result<()> {
        if at != self.set_for {
            self.set(at)?;
            // The kernel has discarded the expiry of the former setting, so there is nothing to read. What expires
            // from now on is an edge of its own, and survives that the former readiness is cleared.
            if let Poll::Ready(guard) = self.timer.poll_read_ready(cx) {
                guard?.clear_ready();
            }
        }
        while let Poll::Ready(guard) = self.timer.poll_read_ready(cx) {
            let mut guard = guard?;
            let mut expirations = [0; 8];
            match rustix::io::read(self.timer.get_ref(), &mut expirations) {
                Ok(_) => {
                    self.set_for = None;
                    // The time passed after the caller read the clock.
                    cx.waker().wake_by_ref();
                    guard.clear_ready();
                }
                Err(rustix::io::Errno::AGAIN) => guard.clear_ready(),
                Err(error) => return Err(error.into()),
            }
        }
        Ok(())
    }

    fn set(&mut self, at: Option<Time>) -> io::Result<()> {
        // Zero would mean "never" to the kernel; the first nanosecond after boot means "at once".
        let nanos = at.map_or(0, |at| at.as_nanos().max(1));
        let value = Timespec {
            tv_sec: (nanos / 1_000_000_000).cast_signed(),
            tv_nsec: (nanos % 1_000_000_000).cast_signed(),
        };
        let setting = Itimerspec { it_interval: Timespec { tv_sec: 0, tv_nsec: 0 }, it_value: value };
        timerfd_settime(self.timer.get_ref(), TimerfdTimerFlags::ABSTIME, &setting)?;
        self.set_for = at;
        Ok(())
    }
}
