//! Replacements for `linux.rs` on other systems: the operations do nothing, or return an error.

use std::{ffi::CStr, io};

use thread_priority::{NormalThreadSchedulePolicy, ThreadSchedulePolicy};

use crate::time::Time;

/// The ordinary policy: there is no idle scheduling.
pub(crate) const IDLE: ThreadSchedulePolicy = ThreadSchedulePolicy::Normal(NormalThreadSchedulePolicy::Other);

/// Returns zero: no thread ID is available through a safe API.
pub(crate) fn thread_id() -> i32 {
    0
}

/// Does nothing: the thread keeps its initial name.
pub(crate) fn name_thread(_: &CStr) {}

/// Returns an error: there is no API for it.
pub(crate) fn pin_to(_: usize) -> io::Result<()> {
    Err(io::Error::new(io::ErrorKind::Unsupported, "this system keeps no thread on one CPU"))
}

/// Does nothing: no thread is pinned.
pub(crate) fn unpin() -> io::Result<()> {
    Ok(())
}

/// Does nothing: no thread is pinned.
pub(crate) fn restore_affinity() -> io::Result<()> {
    Ok(())
}

/// Returns no limit: a priority that was refused once stays refused.
pub(crate) fn realtime_limit() -> u8 {
    0
}

/// Sleeps for the time until `at`: there is no API for a sleep to a deadline.
pub(crate) fn sleep_until(at: Time) {
    std::thread::sleep(at.since(Time::now()));
}
