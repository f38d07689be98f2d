//! The length of a thread's wait, and its early end.

use std::{
    os::fd::BorrowedFd,
    time::{Duration, Instant},
};

/// Reading the clock costs as much as a few reads of memory.
const POLLS_PER_CLOCK_READ: u32 = 32;

/// Longer than any machine runs.
const AGES: Duration = Duration::from_secs(1 << 32);

/// The ends of a wait: always a deadline, and the peer's end if it can be detected.
#[derive(Clone, Copy, Debug)]
pub struct Wait<'a> {
    end: End,
    hang_up: Option<HangUp<'a>>,
}

#[derive(Clone, Copy, Debug)]
enum End {
    At(Instant),
    /// Counted from the moment at which the ring is found empty: a message that is present at once needs no
    /// read of the clock.
    After(Duration),
}

/// A descriptor that shows the peer's end. The memory itself does not show it.
#[derive(Clone, Copy, Debug)]
pub enum HangUp<'a> {
    /// A pidfd of the peer: readable when its process has ended.
    Process(BorrowedFd<'a>),
    /// A socket with another end that only the peer has: hung up when that is closed. Its data is not read.
    Socket(BorrowedFd<'a>),
}

impl<'a> Wait<'a> {
    /// Waits until then at most. A time in the past means: check, and do not wait.
    #[must_use]
    pub const fn until(deadline: Instant) -> Self {
        Self { end: End::At(deadline), hang_up: None }
    }

    /// Waits for this time at most.
    #[must_use]
    pub const fn within(time: Duration) -> Self {
        Self { end: End::After(time), hang_up: None }
    }

    /// Ends the wait early when the peer ends.
    #[must_use]
    pub const fn or_hang_up(self, hang_up: HangUp<'a>) -> Self {
        Self { hang_up: Some(hang_up), ..self }
    }

    /// Starts the wait now.
    pub(crate) fn begin(&self, now: Instant) -> Waiting<'a> {
        let until = match self.end {
            End::At(deadline) => deadline,
            // A time beyond the range of the clock is replaced by one that makes no difference.
            End::After(time) => now.checked_add(time).unwrap_or_else(|| now + AGES),
        };
        Waiting { until, hang_up: self.hang_up }
    }
}

/// A wait in progress.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Waiting<'a> {
    until: Instant,
    pub(crate) hang_up: Option<HangUp<'a>>,
}

impl Waiting<'_> {
    /// Returns the remaining time, from `now` on.
    pub(crate) fn left(&self, now: Instant) -> Duration {
        self.until.saturating_duration_since(now)
    }
}

/// Polls until `ready`, for `budget` at most. Returns whether it was ready. The first polls come before the
/// clock is read.
pub(crate) fn spin(budget: Duration, ready: impl Fn() -> bool) -> bool {
    if budget.is_zero() {
        return false;
    }
    let mut start = None;
    loop {
        for _ in 0..POLLS_PER_CLOCK_READ {
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

/// The next step of a reactor after it has announced its sleep.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
#[must_use = "a reactor that sleeps although something is there is not woken for it"]
pub enum Armed {
    /// Wait for the descriptor: the peer will ring.
    Sleep,
    /// Do not wait: data is present. The announcement is withdrawn.
    Ready,
}
