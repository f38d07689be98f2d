//! What only Linux does for a thread: a number, a name for people, one CPU, idle scheduling.

use std::{ffi::CStr, sync::OnceLock};

use rustix::{
    process::{Resource, getpid, getrlimit},
    thread::{CpuSet, gettid, sched_getaffinity, sched_setaffinity, set_name},
};
use thread_priority::{NormalThreadSchedulePolicy, ThreadSchedulePolicy};

/// Under this a thread runs only when the CPU has nothing else to do.
pub(super) const IDLE: ThreadSchedulePolicy = ThreadSchedulePolicy::Normal(NormalThreadSchedulePolicy::Idle);

/// The kernel's number of the calling thread.
pub(super) fn thread_id() -> i32 {
    gettid().as_raw_nonzero().get()
}

/// Names the calling thread, for people who look at the process; nothing depends on it.
pub(super) fn name_thread(name: &CStr) {
    let _ = set_name(name);
}

/// Keeps the calling thread on one CPU.
pub(super) fn keep_on(cpu: usize) -> std::io::Result<()> {
    // Before the first thread is kept anywhere.
    the_processes();
    let mut set = CpuSet::new();
    if cpu < CpuSet::MAX_CPU {
        set.set(cpu);
    }
    Ok(sched_setaffinity(None, &set)?)
}

/// Lets the calling thread run on any CPU, whatever whoever made it was kept on: on all of the process's cpuset, also those that `taskset` or
/// systemd's `CPUAffinity=` left out, as for the kernel these are only what each thread begins with.
pub(super) fn keep_on_any() -> std::io::Result<()> {
    let mut set = CpuSet::new();
    (0..CpuSet::MAX_CPU).for_each(|cpu| set.set(cpu));
    Ok(sched_setaffinity(None, &set)?)
}

/// Lets the calling thread run where the process was started to run, by `taskset` say, whatever whoever made it was kept on; on any CPU where
/// none of those is left to the process.
pub(super) fn keep_on_the_processes() -> std::io::Result<()> {
    let kept = the_processes().map(|set| sched_setaffinity(None, set));
    if kept.is_some_and(|kept| kept.is_ok()) { Ok(()) } else { keep_on_any() }
}

/// The CPUs of the first thread when this was asked for first.
fn the_processes() -> Option<&'static CpuSet> {
    static THE_PROCESSES: OnceLock<Option<CpuSet>> = OnceLock::new();
    THE_PROCESSES.get_or_init(|| sched_getaffinity(Some(getpid())).ok()).as_ref()
}

/// The highest real-time priority that this process's limit grants, 0 for none; with CAP_SYS_NICE it is no limit.
pub(super) fn realtime_limit() -> u8 {
    let limit = getrlimit(Resource::Rtprio).current.unwrap_or(u64::MAX);
    u8::try_from(limit).unwrap_or(u8::MAX)
}
