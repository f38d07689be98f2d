//! Delayed wake of the drain task, without a switch to its thread now: the sender of a burst has its next
//! message ready earlier than that. While many more come, the wake is postponed: the sender is about to write them all
//! itself.

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
/// Number of messages within a delay that postpone the wake by another delay. Setting the timer for so many costs less
/// than a wake. With fewer, the sender does not soon have as many as it [writes itself](super::draining).
const JOINED: u32 = 16;
/// Maximum number of delays by which a wake is postponed. With one more, the sender has the 128 messages at which it
/// writes itself. The first message waits for 400 us at most.
const POSTPONED_MAX: u32 = 7;

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
    postponement: Postponement,
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

    /// Counts a message that was added to one that waits for the wake.
    pub(super) fn joined(&mut self) {
        if let Some(timer) = self.timer.as_mut().filter(|timer| timer.is_set) {
            timer.join();
        }
    }

    /// Records that the sender has written the messages that waited for the wake: later ones may postpone it again.
    pub(super) fn written(&mut self) {
        if let Some(timer) = &mut self.timer {
            timer.postponement = Postponement::default();
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
        let (timer, drainer) = (kernel_timer()?, THREAD.with(|thread| *thread));
        Ok(Self { timer, is_set: false, postponement: Postponement::default(), drainer })
    }

    fn wake_later(&mut self) -> bool {
        if THREAD.with(|thread| *thread == self.drainer) {
            return false;
        }
        if self.is_set {
            self.join();
        } else {
            self.is_set = self.set();
            self.postponement = Postponement::default();
        }
        self.is_set
    }

    fn join(&mut self) {
        if self.postponement.join() {
            // If this fails, the timer expires as it was set before.
            self.set();
        }
    }

    /// Sets the timer to one delay from now. Returns whether the system did.
    fn set(&self) -> bool {
        let never = Timespec { tv_sec: 0, tv_nsec: 0 };
        let setting =
            Itimerspec { it_interval: never, it_value: Timespec { tv_sec: 0, tv_nsec: WAKE_DELAY_NS } };
        timerfd_settime(self.timer.get_ref(), TimerfdTimerFlags::empty(), &setting).is_ok()
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

/// The messages that joined the first one, and the delays by which they postponed its wake.
#[derive(Debug, Default)]
struct Postponement {
    joined: u32,
    delays: u32,
}

impl Postponement {
    /// Counts a message. Returns whether it postpones the wake.
    const fn join(&mut self) -> bool {
        self.joined = self.joined.saturating_add(1);
        let postpones = self.joined == JOINED && self.delays < POSTPONED_MAX;
        if postpones {
            (self.joined, self.delays) = (0, self.delays + 1);
        }
        postpones
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn wake_is_postponed_a_bounded_number_of_times() {
        let mut postponement = Postponement::default();
        let postponed: Vec<u32> = (1..=1_000).filter(|_| postponement.join()).collect();
        assert_eq!(postponed, (1..=POSTPONED_MAX).map(|delay| delay * JOINED).collect::<Vec<_>>());
    }
}
