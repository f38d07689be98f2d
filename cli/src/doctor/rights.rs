//! Checks limits, real-time rights, and the power management of idle CPUs.

use std::{collections::BTreeSet, fs};

use rustix::{
    fs::{MemfdFlags, SealFlags, fcntl_add_seals, ftruncate, memfd_create},
    process::{PidfdFlags, Resource, getpid, getrlimit, pidfd_open},
    thread::{CapabilitySet, capabilities},
};
use sinew::protection::SAFE_OUTPUT_PRIORITY;
use thread_priority::{
    RealtimeThreadSchedulePolicy, ThreadPriority, ThreadPriorityValue, ThreadSchedulePolicy,
    set_thread_priority_and_policy, thread_native_id,
};

use super::Check;

/// Number of open files that a node with all its clients and their rings may need.
const FILES_WANTED: u64 = 4_096;
/// Memory that a control program may want to lock, in bytes: its stacks, its heap, the rings.
const LOCKED_WANTED: u64 = 64 << 20;
/// The file for limits of users.
const LIMITS: &str = "/etc/security/limits.d/sinew.conf";

pub(super) fn open_files() -> Check {
    let limit = getrlimit(Resource::Nofile);
    let (now, most) = (limit.current.unwrap_or(u64::MAX), limit.maximum.unwrap_or(u64::MAX));
    let detail = format!(
        "a process may have {now} files open (RLIMIT_NOFILE), at most {most}; {FILES_WANTED} are enough for a full node"
    );
    if now >= FILES_WANTED {
        return Check::fine("open files", detail);
    }
    let fix = if most >= FILES_WANTED {
        format!("ulimit -n {FILES_WANTED}, or LimitNOFILE={FILES_WANTED} in the service's unit")
    } else {
        format!("echo '* - nofile {FILES_WANTED}' | sudo tee -a {LIMITS}, then log in again")
    };
    Check::finding("open files", detail, fix)
}

/// Sinew itself locks no memory; a program with a control loop does.
pub(super) fn locked_memory() -> Check {
    const NAME: &str = "locked memory";
    let limit = getrlimit(Resource::Memlock).current;
    if limit.is_none_or(|limit| limit >= LOCKED_WANTED) || has(CapabilitySet::IPC_LOCK) {
        let most = limit.map_or_else(|| "any".to_owned(), |limit| format!("{} KiB", limit >> 10));
        return Check::fine(NAME, format!("a process may lock {most} (RLIMIT_MEMLOCK, or CAP_IPC_LOCK)"));
    }
    Check::finding(
        NAME,
        format!(
            "a process may lock {} KiB (RLIMIT_MEMLOCK); a control loop that calls mlockall needs more, else it waits for the disk",
            limit.unwrap_or(0) >> 10
        ),
        format!(
            "echo \"$USER - memlock unlimited\" | sudo tee -a {LIMITS}, then log in again; or LimitMEMLOCK=infinity in the service's unit"
        ),
    )
}

/// Tested on a thread that ends with the test: the limits are not always effective (in containers). The threads that
/// make outputs safe need the highest of the required priorities; the node's watchdog would use a slightly higher one.
pub(super) fn real_time() -> Check {
    const NAME: &str = "real-time rights";
    let trial = |priority: u8| {
        let level = ThreadPriorityValue::try_from(priority)
            .map_err(|_| thread_priority::Error::Priority("1 to 99"))?;
        let policy = ThreadSchedulePolicy::Realtime(RealtimeThreadSchedulePolicy::Fifo);
        set_thread_priority_and_policy(thread_native_id(), ThreadPriority::Crossplatform(level), policy)
    };
    let trials = move || (trial(1), trial(SAFE_OUTPUT_PRIORITY));
    let limit =
        getrlimit(Resource::Rtprio).current.map_or_else(|| "any".to_owned(), |limit| limit.to_string());
    let capability = if has(CapabilitySet::SYS_NICE) { "with" } else { "without" };
    let known = format!("RLIMIT_RTPRIO {limit}, {capability} CAP_SYS_NICE");
    let detail = match std::thread::spawn(trials).join() {
        Ok((_, Ok(()))) => {
            return Check::fine(
                NAME,
                format!("a thread got SCHED_FIFO {SAFE_OUTPUT_PRIORITY} ({known}){}", throttled()),
            );
        }
        Ok((Ok(()), Err(error))) => format!(
            "a thread got SCHED_FIFO 1, and not the {SAFE_OUTPUT_PRIORITY} of what makes outputs safe: {error:?} ({known}); that takes the \
             highest that it gets, and comes too late where what it guards has one as high or higher: that is refused a guard"
        ),
        Ok((Err(error), Err(_))) => format!("a thread did not get SCHED_FIFO: {error:?} ({known})"),
        Err(_) => {
            return Check::finding(NAME, "the trial panicked".to_owned(), "report it, please");
        }
    };
    Check::finding(
        NAME,
        detail,
        format!(
            "echo \"$USER - rtprio 99\" | sudo tee -a {LIMITS}, then log in again; or LimitRTPRIO=99 in the service's unit; or sudo setcap \
             cap_sys_nice+ep PROGRAM; in a container: --cap-add SYS_NICE --ulimit rtprio=99"
        ),
    )
}

/// Returns whether the kernel takes the CPU from real-time threads that never sleep: information, not a finding.
fn throttled() -> String {
    let read = |name| fs::read_to_string(format!("/proc/sys/kernel/{name}")).ok()?.trim().parse::<i64>().ok();
    match (read("sched_rt_runtime_us"), read("sched_rt_period_us")) {
        (Some(runtime), Some(period)) if 0 < runtime && runtime < period => {
            format!("; all of them together have {runtime} us of each {period} us (sched_rt_runtime_us)")
        }
        _ => String::new(),
    }
}

fn has(capability: CapabilitySet) -> bool {
    capabilities(None).is_ok_and(|sets| sets.effective.contains(capability))
}

/// Checks the CPU governor: a CPU with a reduced clock handles its first message late.
pub(super) fn governor() -> Check {
    const NAME: &str = "CPU governor";
    let cpus = fs::read_dir("/sys/devices/system/cpu").into_iter().flatten().flatten();
    let governors =
        cpus.filter_map(|cpu| fs::read_to_string(cpu.path().join("cpufreq/scaling_governor")).ok());
    let governors: BTreeSet<_> = governors.map(|governor| governor.trim().to_owned()).collect();
    let detail = governors.iter().cloned().collect::<Vec<_>>().join(", ");
    if governors.is_empty() {
        return Check::fine(
            NAME,
            "the kernel does not choose the clock here (a virtual machine, or it is fixed)".to_owned(),
        );
    }
    if governors.iter().all(|governor| governor == "performance") {
        return Check::fine(NAME, detail);
    }
    Check::finding(
        NAME,
        format!("{detail}: a CPU that has slept is slow at first, which a control loop sees as jitter"),
        "echo performance | sudo tee /sys/devices/system/cpu/cpu*/cpufreq/scaling_governor",
    )
}

pub(super) fn shared_memory() -> Check {
    const NAME: &str = "shared memory";
    let trial = || -> rustix::io::Result<()> {
        let file = memfd_create("sinew-doctor", MemfdFlags::CLOEXEC | MemfdFlags::ALLOW_SEALING)?;
        ftruncate(&file, 4_096)?;
        fcntl_add_seals(&file, SealFlags::SHRINK | SealFlags::GROW | SealFlags::SEAL)
    };
    match trial() {
        Ok(()) => Check::fine(NAME, "memfd_create and its seals work".to_owned()),
        Err(error) => Check::finding(
            NAME,
            format!(
                "no sealed memory: {error}; other processes are reached through sockets, which is slower"
            ),
            "allow memfd_create in the container's seccomp profile, as podman run --security-opt seccomp=unconfined ..",
        ),
    }
}

/// Checks pidfd support: the node monitors the process of an application with `own_process` through a descriptor.
pub(super) fn own_processes() -> Check {
    const NAME: &str = "own processes";
    match pidfd_open(getpid(), PidfdFlags::empty()) {
        Ok(_) => {
            Check::fine(NAME, "pidfd_open works: applications may have processes of their own".to_owned())
        }
        Err(error) => Check::finding(
            NAME,
            format!(
                "pidfd_open fails: {error}; a node with an application that has `own_process` does not start"
            ),
            "Linux 5.4 or newer, and a seccomp profile of the container that allows pidfd_open and waitid",
        ),
    }
}
