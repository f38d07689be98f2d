//! How long a thread waits, and what ends it early.

use std::{
    os::fd::BorrowedFd,
    time::{Duration, Instant},
};

/// Reading the clock costs as much as a few looks at memory.
const LOOKS_A_CLOCK: u32 = 32;

/// Longer than any machine runs.
const AGES: Duration = Duration::from_secs(1 << 32);

/// What a thread that waits is told by: a deadline always, the peer's end if it can be seen.
#[derive(Clone, Copy, Debug)]
pub struct Wait<'a> {
    end: End,
    hang_up: Option<HangUp<'a>>,
}

#[derive(Clone, Copy, Debug)]
enum End {
    At(Instant),
    /// From the moment on at which there is nothing: who finds something at once need not read the clock.
    After(Duration),
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
        Self { end: End::At(deadline), hang_up: None }
    }

    /// Waits for so long at most.
    #[must_use]
    pub const fn within(time: Duration) -> Self {
        Self { end: End::After(time), hang_up: None }
    }

    /// Ends early when the peer does.
    #[must_use]
    pub const fn or_hang_up(self, hang_up: HangUp<'a>) -> Self {
        Self { hang_up: Some(hang_up), ..self }
    }

    /// The wait begins now.
    pub(crate) fn begin(&self, now: Instant) -> Waiting<'a> {
        let until = match self.end {
            End::At(deadline) => deadline,
            // Later than time goes is as late as makes no difference.
            End::After(time) => now.checked_add(time).unwrap_or_else(|| now + AGES),
        };
        Waiting { until, hang_up: self.hang_up }
    }
}

/// A wait that has begun.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Waiting<'a> {
    until: Instant,
    pub(crate) hang_up: Option<HangUp<'a>>,
}

impl Waiting<'_> {
    /// What is left, from `now` on.
    pub(crate) fn left(&self, now: Instant) -> Duration {
        self.until.saturating_duration_since(now)
    }
}

/// Looks until `ready`, for `budget` at most. Whether it was ready. The first looks come before the clock is read.
pub(crate) fn spin(budget: Duration, ready: impl Fn() -> bool) -> bool {
    if budget.is_zero() {
        return false;
    }
    let mut start = None;
    loop {
        for _ in 0..LOOKS_A_CLOCK {
            if ready() {
                return true;
            }
            std::hint::spin_loop();
        }
        if start.get_or_insert_with(Instant::now).elapsed() >= budget {
            return false;
        }
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
