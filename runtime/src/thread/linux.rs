//! Thread operations that exist only on Linux: the thread ID, the name, the affinity to one CPU, idle scheduling.

use std::{ffi::CStr, sync::OnceLock};

use rustix::{
    process::{Resource, getpid, getrlimit},
    thread::{CpuSet, clock_nanosleep_absolute, gettid, sched_getaffinity, sched_setaffinity, set_name},
    time::{ClockId, Timespec},
};
use thread_priority::{NormalThreadSchedulePolicy, ThreadSchedulePolicy};

use crate::time::Time;

/// The scheduling policy under which a thread runs only when the CPU is idle.
pub(crate) const IDLE: ThreadSchedulePolicy = ThreadSchedulePolicy::Normal(NormalThreadSchedulePolicy::Idle);

/// Returns the kernel's ID of the calling thread.
pub(crate) fn thread_id() -> i32 {
    gettid().as_raw_nonzero().get()
}

/// Sets the name of the calling thread, for process listings only.
pub(crate) fn name_thread(name: &CStr) {
    let _ = set_name(name);
}

/// Pins the calling thread to one CPU.
pub(crate) fn pin_to(cpu: usize) -> std::io::Result<()> {
    // Before the first thread is pinned.
    process_affinity();
    let mut set = CpuSet::new();
    if cpu < CpuSet::MAX_CPU {
        set.set(cpu);
    }
    Ok(sched_setaffinity(None, &set)?)
}

/// Lets the calling thread run on any CPU, independent of the affinity that it inherited: on all CPUs of the
/// process's cpuset. This includes CPUs excluded by `taskset` or systemd's `CPUAffinity=`, which set only the
/// initial affinity of a thread.
pub(crate) fn unpin() -> std::io::Result<()> {
    let mut set = CpuSet::new();
    (0..CpuSet::MAX_CPU).for_each(|cpu| set.set(cpu));
    Ok(sched_setaffinity(None, &set)?)
}

/// Sets the affinity of the calling thread to that of the process at its start, for example by `taskset`,
/// independent of the inherited affinity. Sets it to any CPU if none of those is available.
pub(crate) fn restore_affinity() -> std::io::Result<()> {
    let kept = process_affinity().map(|set| sched_setaffinity(None, set));
    if kept.is_some_and(|kept| kept.is_ok()) { Ok(()) } else { unpin() }
}

/// Returns the CPUs of the first thread at the first call.
fn process_affinity() -> Option<&'static CpuSet> {
    static PROCESS_AFFINITY: OnceLock<Option<CpuSet>> = OnceLock::new();
    PROCESS_AFFINITY.get_or_init(|| sched_getaffinity(Some(getpid())).ok()).as_ref()
}

/// Returns the highest real-time priority that this process's limit grants, 0 for none; CAP_SYS_NICE
/// overrides the limit.
pub(crate) fn realtime_limit() -> u8 {
    let limit = getrlimit(Resource::Rtprio).current.unwrap_or(u64::MAX);
    u8::try_from(limit).unwrap_or(u8::MAX)
}

/// Sleeps until `at` on the monotonic clock. A signal may end the sleep early.
pub(crate) fn sleep_until(at: Time) {
    let nanos = at.as_nanos();
    let at = Timespec {
        tv_sec: (nanos / 1_000_000_000).cast_signed(),
        tv_nsec: (nanos % 1_000_000_000).cast_signed(),
    };
    // The only error of a legal time is the interruption by a signal.
    let _ = clock_nanosleep_absolute(ClockId::Monotonic, &at);
}
