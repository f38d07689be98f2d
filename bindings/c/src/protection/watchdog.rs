//! Starts the runtime's threads that make outputs safe in time, for a process in C.

use std::sync::atomic::{AtomicU32, Ordering};

use sinew_runtime::protection::raw;

use crate::{
    fork,
    log::{self, without_signals},
    status::{CallError, Status},
};

/// No guard was requested yet. No process has this number of forks.
const NEVER: u32 = u32::MAX;

/// Number of forks when this process first requested a guard, successfully or not. A child of `fork` has no
/// such threads, and locks that they held stay locked in it.
static FIRST_FORKS: AtomicU32 = AtomicU32::new(NEVER);

/// Starts the threads if there are none, and rejects a thread that they could not preempt. All signals are
/// blocked in them: those are the program's.
pub(super) fn begin() -> Result<(), CallError> {
    log::begin();
    fork::watch()?;
    // Set before the threads exist: a child that is forked meanwhile is rejected, instead of having outputs
    // that no thread makes safe.
    // SYNC: Relaxed, as no other data depends on it; a child sees everything that its parent's thread has
    // written or seen.
    let _ = FIRST_FORKS.compare_exchange(NEVER, fork::generation(), Ordering::Relaxed, Ordering::Relaxed);
    check_fork()?;
    without_signals(raw::begin)
        .map_err(|error| CallError::new(Status::SinewErrorNoWatchdog, error.to_string()))
}

/// Rejects a child of the process that has the guards.
pub(super) fn check_fork() -> Result<(), CallError> {
    let first = FIRST_FORKS.load(Ordering::Relaxed);
    if first == NEVER || first == fork::generation() {
        return Ok(());
    }
    let sentence =
        "the guards belong to the process that this one was forked from, which keeps their watchdogs";
    Err(CallError::new(Status::SinewErrorForked, sentence))
}
