//! A future that ends at a time of a clock.

use std::{
    pin::Pin,
    task::{Context, Poll, ready},
};

use super::{Clock, timer_runtime, virtual_time::VirtualAlarm};
use crate::time::Time;

/// A future that ends at a time of a [`Clock`], made by [`Clock::sleep`]. Its timer is created at the first poll. A
/// tokio runtime that polls it must have its time enabled. Where the system provides no timer it ends at
/// once, which is logged.
#[derive(Debug)]
#[must_use = "a future does nothing unless it is polled"]
pub struct Sleep {
    clock: Clock,
    until: Time,
    timer: Option<Timer>,
}

#[derive(Debug)]
enum Timer {
    Wall(Pin<Box<tokio::time::Sleep>>),
    Virtual(VirtualAlarm),
}

impl Sleep {
    pub(super) const fn new(clock: Clock, until: Time) -> Self {
        Self { clock, until, timer: None }
    }

    /// Creates the timer; `None` if the time has passed, or if there is none.
    fn start(&self) -> Option<Timer> {
        let now = self.clock.now();
        if self.until <= now {
            return None;
        }
        match &self.clock.0 {
            None => timer_runtime::sleep(self.until.since(now)).map(Timer::Wall),
            Some(shared) => Some(Timer::Virtual(VirtualAlarm::new(shared.clone()))),
        }
    }
}

impl Future for Sleep {
    type Output = ();

    fn poll(mut self: Pin<&mut Self>, task: &mut Context<'_>) -> Poll<()> {
        if self.timer.is_none() {
            self.timer = self.start();
        }
        let (until, is_over) = (self.until, self.clock.is_virtual() && self.until <= self.clock.now());
        match &mut self.timer {
            Some(Timer::Wall(timer)) => ready!(timer.as_mut().poll(task)),
            Some(Timer::Virtual(alarm)) if !is_over => {
                alarm.wake_at(Some(until), task);
                return Poll::Pending;
            }
            Some(Timer::Virtual(_)) | None => {}
        }
        Poll::Ready(())
    }
}
