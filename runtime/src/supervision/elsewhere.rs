//! Where there is no Linux: what `linux.rs` does for a thread is done without, or refused in words.

use std::{ffi::CStr, io};

use thread_priority::{NormalThreadSchedulePolicy, ThreadSchedulePolicy};

/// There is no idle scheduling.
pub(super) const IDLE: ThreadSchedulePolicy = ThreadSchedulePolicy::Normal(NormalThreadSchedulePolicy::Other);

/// There is no number that is told safely; zero is none.
pub(super) fn thread_id() -> i32 {
    0
}

/// The name that the thread was started with stays.
pub(super) fn name_thread(_: &CStr) {}

/// There is no way to.
pub(super) fn keep_on(_: usize) -> io::Result<()> {
    Err(io::Error::new(io::ErrorKind::Unsupported, "this system keeps no thread on one CPU"))
}

/// It is kept on none.
pub(super) fn keep_on_any() -> io::Result<()> {
    Ok(())
}

/// The same.
pub(super) fn keep_on_the_processes() -> io::Result<()> {
    Ok(())
}

/// There is no such limit: what is refused once stays so.
pub(super) fn realtime_limit() -> u8 {
    0
}
