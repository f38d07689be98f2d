//! A task alarm for systems without timerfd: tokio's timer wheel, which has a tick of a millisecond.

use std::{
    io,
    pin::Pin,
    task::{Context, Poll},
};

use tokio::time::{Instant, Sleep, sleep};

use crate::time::Time;

/// One timer of the reactor.
#[derive(Debug)]
pub struct Alarm {
    sleep: Pin<Box<Sleep>>,
    set_for: Option<Time>,
}

impl Alarm {
    /// Creates a timer that is not set, in the reactor of the calling thread.
    ///
    /// # Errors
    ///
    /// None here.
    #[allow(clippy::unnecessary_wraps, reason = "as in `alarm.rs`, where the system may give none")]
    pub fn new() -> io::Result<Self> {
        Ok(Self { sleep: Box::pin(sleep(std::time::Duration::ZERO)), set_for: None })
    }

    /// Wakes the task at `at`, or soon if that has passed; never if `at` is `None`.
    ///
    /// # Errors
    ///
    /// None here.
    #[allow(clippy::unnecessary_wraps, reason = "as in `alarm.rs`, where the system may refuse")]
    pub fn wake_at(&mut self, at: Option<Time>, cx: &mut Context<'_>) -> io::Result<()> {
        if at != self.set_for {
            self.set_for = at;
            if let Some(at) = at {
                self.sleep.as_mut().reset(Instant::now() + at.since(Time::now()));
            }
        }
        if self.set_for.is_some() && self.sleep.as_mut().poll(cx) == Poll::Ready(()) {
            self.set_for = None;
            // The time passed after the caller read the clock.
            cx.waker().wake_by_ref();
        }
        Ok(())
    }
}
