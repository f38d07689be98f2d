//! What makes outputs safe in time: the runtime's threads, begun for a process of C's.

use std::sync::atomic::{AtomicU32, Ordering};

use sinew::protection::raw;

use crate::{
    fork,
    log::{self, without_signals},
    status::{Fault, Status},
};

/// No guard was wanted yet. So many forks no process has behind it.
const NEVER: u32 = u32::MAX;

/// How many forks the process had behind it that first wanted a guard, whether it got one or not: a child has no such threads, and what they had locked stays so.
static BORN: AtomicU32 = AtomicU32::new(NEVER);

/// Starts the threads if there are none, and refuses whoever would not be interrupted by them. They take no signals: those are the program's.
pub(super) fn begin() -> Result<(), Fault> {
    log::begin();
    fork::watch()?;
    // Before they are there: who forks meanwhile has a child that is refused, and not one whose outputs nobody makes safe.
    // SYNC: Relaxed, as nothing is read behind it; a child has all that its parent's thread has written or seen.
    let _ = BORN.compare_exchange(NEVER, fork::generation(), Ordering::Relaxed, Ordering::Relaxed);
    check_fork()?;
    without_signals(raw::begin).map_err(|error| Fault::new(Status::SinewErrorNoWatchdog, error.to_string()))
}

/// Refuses a child of the process whose guards these are.
pub(super) fn check_fork() -> Result<(), Fault> {
    let born = BORN.load(Ordering::Relaxed);
    if born == NEVER || born == fork::generation() {
        return Ok(());
    }
    let sentence =
        "the guards belong to the process that this one was forked from, which keeps their watchdogs";
    Err(Fault::new(Status::SinewErrorForked, sentence))
}
