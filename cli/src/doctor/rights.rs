//! Checks limits, real-time rights, and the power management of idle CPUs.

use std::time::Duration;

use rustix::{
    fs::{MemfdFlags, SealFlags, fcntl_add_seals, ftruncate, memfd_create},
    io::Errno,
    process::{PidfdFlags, Resource, getpid, getrlimit, pidfd_open},
};
use sinew::{
    protection::SAFE_OUTPUT_PRIORITY,
    real_time::{Budget, HostRights, Plan, Refusal, probe},
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
pub(super) fn locked_memory(rights: &HostRights) -> Check {
    let limit = rights.locked_limit;
    if limit >= LOCKED_WANTED || rights.has_ipc_lock {
        let most = if limit == u64::MAX { "any".to_owned() } else { format!("{} KiB", limit >> 10) };
        return Check::fine(LOCKED, format!("a process may lock {most} (RLIMIT_MEMLOCK, or CAP_IPC_LOCK)"));
    }
    unlockable(format!(
        "a process may lock {} KiB (RLIMIT_MEMLOCK); a control loop that calls mlockall needs more, else it waits for the disk",
        limit >> 10
    ))
}

const LOCKED: &str = "locked memory";

/// Judges the result of `mlockall`.
pub(super) fn locked(result: Result<(), Errno>) -> Check {
    match result {
        Ok(()) => Check::fine(LOCKED, "mlockall works: the memory of this command is locked".to_owned()),
        Err(error) => unlockable(format!("mlockall fails: {error}; a control loop may wait for the disk")),
    }
}

fn unlockable(detail: String) -> Check {
    Check::finding(
        LOCKED,
        detail,
        format!(
            "echo \"$USER - memlock unlimited\" | sudo tee -a {LIMITS}, then log in again; or LimitMEMLOCK=infinity in the service's unit; in a \
             container: --ulimit memlock=-1"
        ),
    )
}

/// Tested on a thread that ends with the test: the limits are not always effective (in containers). The threads that
/// make outputs safe need the highest of the required priorities; the node's watchdog would use a slightly higher one.
pub(super) fn real_time(rights: &HostRights) -> Check {
    let trial = Plan::new(Some(SAFE_OUTPUT_PRIORITY), Duration::ZERO);
    match std::thread::spawn(move || probe(&trial, || false).granted).join() {
        Ok(granted) => judged(rights, granted),
        Err(_) => Check::finding(REAL_TIME, "the trial panicked".to_owned(), "report it, please"),
    }
}

const REAL_TIME: &str = "real-time rights";

/// Judges the priority that a thread got. Each reason of a refusal has its fix.
pub(super) fn judged(rights: &HostRights, granted: u8) -> Check {
    let refusals = rights.refusals(SAFE_OUTPUT_PRIORITY, granted);
    if refusals.is_empty() {
        let detail = format!("a thread got SCHED_FIFO {granted} ({}){}", known(rights), throttled(rights));
        return Check::fine(REAL_TIME, detail);
    }
    let reasons: Vec<_> = refusals.iter().map(ToString::to_string).collect();
    let reasons = reasons.join("; ");
    let detail = if granted > 0 {
        format!(
            "a thread got SCHED_FIFO {granted}, and not the {SAFE_OUTPUT_PRIORITY} of what makes outputs safe: {reasons}; that takes the \
             highest that it gets, and comes too late where what it guards has one as high or higher: that is refused a guard"
        )
    } else {
        format!("a thread did not get SCHED_FIFO: {reasons} ({})", known(rights))
    };
    Check::finding(REAL_TIME, detail, refusals.iter().map(fix).collect::<Vec<_>>().join("\n"))
}

fn known(rights: &HostRights) -> String {
    let limit = match rights.priority_limit {
        u64::MAX => "any".to_owned(),
        limit => limit.to_string(),
    };
    let capability = if rights.has_sys_nice { "with" } else { "without" };
    format!("RLIMIT_RTPRIO {limit}, {capability} CAP_SYS_NICE")
}

/// Returns the fix for one reason of a refusal.
fn fix(refusal: &Refusal) -> String {
    let no_limit = "sudo sysctl -w kernel.sched_rt_runtime_us=-1: no group needs a budget then, and no real-time thread that never sleeps is stopped any more";
    match refusal {
        Refusal::NoRight { .. } => format!(
            "echo \"$USER - rtprio 99\" | sudo tee -a {LIMITS}, then log in again; or LimitRTPRIO=99 in the service's unit; or sudo setcap \
             cap_sys_nice+ep PROGRAM; in a container: --cap-add=SYS_NICE --ulimit rtprio=99"
        ),
        Refusal::NoBudget(Budget::NoneV1 { file, .. }) => format!(
            "echo 950000 | sudo tee {}, after the same for each group above it; in a container: --cpu-rt-runtime=950000, with \
             dockerd --cpu-rt-runtime=950000; or {no_limit}",
            file.display()
        ),
        Refusal::NoBudget(Budget::NoneV2 { .. } | Budget::MaybeNoneV2 { .. }) => format!(
            "{no_limit}; or rt_group_sched=0 on the kernel's command line (newer kernels), or a kernel without CONFIG_RT_GROUP_SCHED"
        ),
        Refusal::NoBudget(Budget::NotRestricted) | Refusal::Unknown => {
            "in a container: --cap-add=SYS_NICE --ulimit rtprio=99, a seccomp profile that allows sched_setscheduler, and the host's user namespace \
             (--userns=host)"
                .to_owned()
        }
    }
}

/// Returns whether the kernel takes the CPU from real-time threads that never sleep: information, not a finding.
fn throttled(rights: &HostRights) -> String {
    match (rights.runtime_us, rights.period_us) {
        (Some(runtime), Some(period)) if 0 <= runtime && runtime < period => {
            format!("; all of them together have {runtime} us of each {period} us (sched_rt_runtime_us)")
        }
        _ => String::new(),
    }
}

/// Checks the CPU governor: a CPU with a reduced clock handles its first message late.
pub(super) fn governor(rights: &HostRights) -> Check {
    const NAME: &str = "CPU governor";
    let detail = rights.governors.iter().cloned().collect::<Vec<_>>().join(", ");
    if rights.governors.is_empty() {
        return Check::fine(
            NAME,
            "the kernel does not choose the clock here (a virtual machine, or it is fixed)".to_owned(),
        );
    }
    if rights.governors.iter().all(|governor| governor == "performance") {
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

#[cfg(test)]
mod tests {
    use std::path::Path;

    use super::*;

    #[test]
    fn every_reason_of_a_refusal_has_a_fix() {
        let rights = HostRights::read(Path::new("/nowhere"));
        let none = Budget::NoneV1 {
            group: "/robot".to_owned(),
            file: "/sys/fs/cgroup/cpu/robot/cpu.rt_runtime_us".into(),
        };
        let both = judged(&HostRights { budget: none, ..rights.clone() }, 0);
        assert!(
            both.detail.contains("RLIMIT_RTPRIO is 0") && both.detail.contains("/robot"),
            "{}",
            both.detail
        );
        let fix = both.fix.expect("a finding");
        let parts = [
            "rtprio 99",
            "LimitRTPRIO=99",
            "--cap-add=SYS_NICE",
            "tee /sys/fs/cgroup/cpu/robot/cpu.rt_runtime_us",
        ];
        assert!(parts.iter().all(|part| fix.contains(part)), "{fix}");
        let budget = Budget::NoneV2 { group: "/robot".to_owned() };
        let of_group = judged(&HostRights { budget, has_sys_nice: true, ..rights.clone() }, 0);
        assert!(of_group.fix.is_some_and(|fix| fix.contains("rt_group_sched=0") && !fix.contains("rtprio")));
        let unknown = judged(&HostRights { has_sys_nice: true, ..rights.clone() }, 0);
        assert!(unknown.fix.is_some_and(|fix| fix.contains("seccomp")));
        assert!(judged(&rights, SAFE_OUTPUT_PRIORITY).fix.is_none());
        assert!(judged(&rights, 40).detail.contains("SCHED_FIFO 40, and not the 90"));
    }

    #[test]
    fn memory_that_cannot_be_locked_is_a_finding() {
        let fix = locked(Err(Errno::NOMEM)).fix.expect("a finding");
        assert!(fix.contains("memlock unlimited") && fix.contains("--ulimit memlock=-1"), "{fix}");
        assert!(locked(Ok(())).fix.is_none());
        let rights = HostRights::read(Path::new("/nowhere"));
        assert!(locked_memory(&rights).fix.is_some());
        assert!(locked_memory(&HostRights { has_ipc_lock: true, ..rights }).fix.is_none());
    }
}
