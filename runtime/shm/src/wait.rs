//! How long a thread waits, and what ends it early.

use std::{
    os::fd::BorrowedFd,
    time::{Duration, Instant},
};

/// Reading the clock costs as much as a few looks at memory.
const LOOKS_A_CLOCK: u32 = 32;

/// What a thread that waits is told by: a deadline always, the peer's end if it can be seen.
#[derive(Clone, Copy, Debug)]
pub struct Wait<'a> {
    until: Instant,
    hang_up: Option<HangUp<'a>>,
}

/// A descriptor on which the peer's end shows. The memory itself does not tell.
#[derive(Clone, Copy, Debug)]
pub enum HangUp<'a> {
    /// A pidfd of the peer: readable when its process has ended.
    Process(BorrowedFd<'a>),
    /// A socket whose other end only the peer has: hung up when that is closed. What can be read from it is left there.
    Socket(BorrowedFd<'a>),
}

impl<'a> Wait<'a> {
    /// Waits until then at most. A time that is past means: look, and do not wait.
    #[must_use]
    pub const fn until(deadline: Instant) -> Self {
        Self { until: deadline, hang_up: None }
    }

    /// Ends early when the peer does.
    #[must_use]
    pub const fn or_hang_up(self, hang_up: HangUp<'a>) -> Self {
        Self { hang_up: Some(hang_up), ..self }
    }

    /// Looks until `ready`, for `budget` at most and not beyond the deadline. Whether it was ready.
    pub(crate) fn spin(&self, budget: Duration, ready: impl Fn() -> bool) -> bool {
        if budget.is_zero() {
            return false;
        }
        let mut end = None;
        loop {
            for _ in 0..LOOKS_A_CLOCK {
                if ready() {
                    return true;
                }
                std::hint::spin_loop();
            }
            let now = Instant::now();
            let end = *end.get_or_insert_with(|| self.until.min(now + budget));
            if now >= end {
                return false;
            }
        }
    }

    pub(crate) const fn hang_up(&self) -> Option<HangUp<'a>> {
        self.hang_up
    }

    /// What is left, from `now` on.
    pub(crate) fn left(&self, now: Instant) -> Duration {
        self.until.saturating_duration_since(now)
    }
}

/// What a reactor does after it has announced that it is about to sleep.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use = "a reactor that sleeps although something is there is not woken for it"]
pub enum Armed {
    /// Wait for the descriptor: the peer will ring.
    Sleep,
    /// Do not wait: there is something. The announcement is withdrawn.
    Ready,
}
