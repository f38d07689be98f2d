//! The clock of an application: the host's monotonic clock, or a virtual one that a test moves.
//!
//! The clock is a value that an application gets with its sender, so several virtual clocks in one process do not
//! disturb each other. On the host's clock a read is one branch and the system call of [`Time::now`].
//!
//! | file | content |
//! | --- | --- |
//! | `virtual_time` | a virtual clock and its wake-ups |
//! | `sleep` | a future that ends at a time of the clock |
//! | `timer_runtime` | tokio timers for threads without a tokio runtime |

mod sleep;
mod timer_runtime;
mod virtual_time;

use std::{
    io,
    sync::Arc,
    task::{Context, Waker},
    time::Duration,
};

use self::virtual_time::VirtualAlarm;
pub(crate) use self::virtual_time::WakeUp;
pub use self::{sleep::Sleep, virtual_time::VirtualTime};
use crate::{alarm::Alarm, time::Time};

/// The clock that an application reads: the host's monotonic clock, or a virtual one.
///
/// [`AppContext::now`](crate::app::AppContext::now) reads it, and the application's timers, input watchdogs,
/// deadlines and guards follow it. Clones read the same clock.
///
/// # Examples
///
/// ```
/// use sinew::prelude::*;
///
/// struct Brake { since: Option<Time> }
/// # impl Actor for Brake { type Context = AppContext<Self>; }
///
/// /// Waits in a future of the actor; in virtual time it takes no time at all.
/// fn release_later(brake: &Brake, ctx: &mut AppContext<Brake>) {
///     let settled = ctx.clock().sleep(Duration::from_millis(200));
///     ctx.spawn(settled.into_actor(brake).map(|(), brake, ctx| brake.since = Some(ctx.now())));
/// }
/// ```
#[derive(Clone, Debug, Default)]
pub struct Clock(Option<Arc<virtual_time::Shared>>);

impl Clock {
    /// The host's monotonic clock.
    pub const WALL: Self = Self(None);

    /// Returns the current time of this clock.
    #[must_use]
    #[inline]
    pub fn now(&self) -> Time {
        match &self.0 {
            None => Time::now(),
            Some(shared) => shared.now(),
        }
    }

    /// Same as [`Time::now_and_asleep`]; a virtual clock never sleeps.
    #[inline]
    pub(crate) fn now_and_asleep(&self) -> (Time, Duration) {
        match &self.0 {
            None => Time::now_and_asleep(),
            Some(shared) => (shared.now(), Duration::ZERO),
        }
    }

    /// Returns whether this clock is a virtual one.
    #[must_use]
    #[inline]
    pub const fn is_virtual(&self) -> bool {
        self.0.is_some()
    }

    /// Returns a future that ends `duration` from now. On the host's clock it needs a tokio runtime only
    /// while it is polled on a thread that has one; other threads share one.
    pub fn sleep(&self, duration: Duration) -> Sleep {
        self.sleep_until(self.now() + duration)
    }

    /// Returns a future that ends at `until`.
    pub fn sleep_until(&self, until: Time) -> Sleep {
        Sleep::new(self.clone(), until)
    }

    /// Creates an alarm of a task that is not set.
    ///
    /// # Errors
    /// The process has no descriptor left, or the calling thread has no reactor. Never for a virtual clock.
    pub(crate) fn alarm(&self) -> io::Result<ClockAlarm> {
        Ok(match &self.0 {
            None => ClockAlarm::Wall(Alarm::new()?),
            Some(shared) => ClockAlarm::Virtual(VirtualAlarm::new(shared.clone())),
        })
    }

    /// Creates a wake-up that is not set, for code that is no task. Returns `None` on the host's clock.
    pub(crate) fn wake_up(&self, waker: impl FnOnce() -> Waker) -> Option<WakeUp> {
        self.0.as_ref().map(|shared| WakeUp::new(shared.clone(), waker()))
    }
}

/// An alarm of a task, on the host's clock or on a virtual one.
#[derive(Debug)]
pub(crate) enum ClockAlarm {
    Wall(Alarm),
    Virtual(VirtualAlarm),
}

impl ClockAlarm {
    /// Wakes the task at `at`, or soon if that has passed; never if `at` is `None`.
    ///
    /// # Errors
    /// The kernel refuses the time.
    pub(crate) fn wake_at(&mut self, at: Option<Time>, task: &mut Context<'_>) -> io::Result<()> {
        match self {
            Self::Wall(alarm) => alarm.wake_at(at, task),
            Self::Virtual(alarm) => {
                alarm.wake_at(at, task);
                Ok(())
            }
        }
    }
}
