//! One kernel timer, on the monotonic clock, in the reactor of the thread that creates it.

use std::{io, os::fd::OwnedFd};

use rustix::time::{TimerfdClockId, TimerfdFlags, timerfd_create};
use tokio::io::unix::AsyncFd;

/// Creates a timer that is not set.
///
/// # Errors
///
/// The process has no descriptor left, or the calling thread has no reactor.
pub fn kernel_timer() -> io::Result<AsyncFd<OwnedFd>> {
    let timer = timerfd_create(TimerfdClockId::Monotonic, TimerfdFlags::NONBLOCK | TimerfdFlags::CLOEXEC)?;
    #[expect(
        deprecated,
        reason = "sound for an OwnedFd, whose descriptor never changes; its successor is an unsafe fn, and unsafe code lives in sinew-shm and the C binding alone"
    )]
    AsyncFd::new(timer)
}
