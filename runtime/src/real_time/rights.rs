//! The real-time rights of a process and the settings of its host, read from the files of the kernel.

use std::{
    collections::BTreeSet,
    fmt,
    fs::{self, File},
    io::Read as _,
    path::{Component, Path, PathBuf},
};

/// Maximum bytes that are read from a file; a kernel's configuration in `/boot` has some 300 KiB.
const FILE_BYTES_MAX: u64 = 1 << 20;
/// Maximum number of entries that are read below `/sys/devices/system/cpu`.
const CPUS_MAX: usize = 8_192;
/// The bits of capabilities in `/proc/self/status`.
const CAP_IPC_LOCK: u32 = 14;
const CAP_SYS_NICE: u32 = 23;

/// The real-time rights of the calling process, and the settings of its host that delay real-time threads.
///
/// # Examples
///
/// ```
/// use std::path::Path;
/// use sinew::real_time::HostRights;
///
/// let rights = HostRights::read(Path::new("/"));
/// println!("RLIMIT_RTPRIO {}, {:?}, memory {}", rights.priority_limit, rights.preemption, rights.locked());
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct HostRights {
    /// The release of the kernel; empty if unknown.
    pub kernel: String,
    /// How the kernel preempts itself.
    pub preemption: Preemption,
    /// The highest SCHED_FIFO priority of RLIMIT_RTPRIO, 0 for none; `u64::MAX`: no limit.
    pub priority_limit: u64,
    /// Maximum bytes that the process may lock, of RLIMIT_MEMLOCK; `u64::MAX`: no limit.
    pub locked_limit: u64,
    /// Whether CAP_SYS_NICE overrides the limit of priorities.
    pub has_sys_nice: bool,
    /// Whether CAP_IPC_LOCK overrides the limit of locked memory.
    pub has_ipc_lock: bool,
    /// Locked memory of the process, in KiB.
    pub locked_kib: u64,
    /// Memory of the process that is in RAM, in KiB.
    pub resident_kib: u64,
    /// Whether the control group of the process may have real-time threads.
    pub budget: Budget,
    /// Time that all real-time threads together have in each period, in microseconds; negative: no limit. `None`:
    /// unknown.
    pub runtime_us: Option<i64>,
    /// That period, in microseconds.
    pub period_us: Option<i64>,
    /// The governors of the CPUs; empty if the kernel does not choose their clocks.
    pub governors: BTreeSet<String>,
    /// The CPUs without ordinary threads (`isolcpus`), as in `2-3`; empty if there are none.
    pub isolated_cpus: String,
}

/// How a kernel preempts itself for a real-time thread.
///
/// # Examples
///
/// ```
/// use sinew::real_time::Preemption;
///
/// assert_ne!(Preemption::RealTime, Preemption::Unknown);
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Preemption {
    /// PREEMPT_RT: almost everywhere.
    RealTime,
    /// PREEMPT_DYNAMIC: as `preempt=` on its command line says.
    Dynamic,
    /// PREEMPT: outside of its locks.
    Full,
    /// Not named: PREEMPT_NONE or PREEMPT_VOLUNTARY, at a few places or none.
    Unknown,
}

/// Whether the control group of a process may have real-time threads (`CONFIG_RT_GROUP_SCHED`).
///
/// # Examples
///
/// ```
/// use sinew::real_time::Budget;
///
/// let none = Budget::NoneV1 { group: "/robot".into(), file: "/sys/fs/cgroup/cpu/robot/cpu.rt_runtime_us".into() };
/// assert_ne!(none, Budget::NotRestricted);
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Budget {
    /// No control group refuses a real-time thread.
    NotRestricted,
    /// A group of cgroup v1 with a `cpu.rt_runtime_us` of 0.
    NoneV1 {
        /// The path of the group.
        group: String,
        /// The file that has the budget.
        file: PathBuf,
    },
    /// A group of cgroup v2 with the controller `cpu`, which can have no budget.
    NoneV2 {
        /// The path of the group.
        group: String,
    },
    /// The same, if the kernel has `CONFIG_RT_GROUP_SCHED`: its configuration cannot be read.
    MaybeNoneV2 {
        /// The path of the group.
        group: String,
    },
}

/// How much of its memory a process has locked.
///
/// # Examples
///
/// ```
/// use sinew::real_time::Locked;
///
/// assert_eq!(Locked::Part.to_string(), "partly locked");
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Locked {
    /// All that is in RAM, as by `mlockall`.
    All,
    /// A part.
    Part,
    /// Nothing.
    None,
}

/// A reason why a thread did not get its real-time priority.
///
/// # Examples
///
/// ```
/// use sinew::real_time::Refusal;
///
/// let refusal = Refusal::NoRight { limit: 0 };
/// assert_eq!(refusal.to_string(), "RLIMIT_RTPRIO is 0, without CAP_SYS_NICE");
/// ```
#[derive(Clone, Debug, PartialEq, Eq)]
pub enum Refusal {
    /// RLIMIT_RTPRIO is lower than the priority, and the process has no CAP_SYS_NICE.
    NoRight {
        /// The limit.
        limit: u64,
    },
    /// The control group has no budget for real-time threads, or may have none.
    NoBudget(Budget),
    /// No known reason: a seccomp profile, a security module, or a user namespace.
    Unknown,
}

impl fmt::Display for Locked {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(match self {
            Self::All => "locked",
            Self::Part => "partly locked",
            Self::None => "not locked",
        })
    }
}

impl fmt::Display for Refusal {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        match self {
            Self::NoRight { limit } => write!(f, "RLIMIT_RTPRIO is {limit}, without CAP_SYS_NICE"),
            Self::NoBudget(Budget::NoneV1 { group, .. }) => {
                write!(f, "the control group {group} has no real-time budget (cpu.rt_runtime_us is 0)")
            }
            Self::NoBudget(Budget::NoneV2 { group }) => {
                write!(f, "the control group {group} has no real-time budget (cgroup v2 has none)")
            }
            Self::NoBudget(Budget::MaybeNoneV2 { group }) => {
                write!(f, "the control group {group} may have no real-time budget (cgroup v2 has none)")
            }
            Self::NoBudget(Budget::NotRestricted) | Self::Unknown => f.write_str(
                "no known reason (a seccomp profile, a security module, or a user namespace refuses it)",
            ),
        }
    }
}

impl HostRights {
    /// Reads the files below `root`, which is `/`; a test gives another folder. Files that cannot be read count as
    /// no right and no setting.
    #[must_use]
    pub fn read(root: &Path) -> Self {
        let proc = |file: &str| text(&root.join("proc").join(file));
        let (limits, status) = (proc("self/limits"), proc("self/status"));
        let version = proc("version");
        let (kernel, runtime_us) =
            (proc("sys/kernel/osrelease"), integer(&proc("sys/kernel/sched_rt_runtime_us")));
        let is_real_time = text(&root.join("sys/kernel/realtime")).trim() == "1";
        let capabilities = field(&status, "CapEff:").and_then(|word| u64::from_str_radix(word, 16).ok());
        let has = |bit: u32| capabilities.is_some_and(|all| all & (1 << bit) != 0);
        let kib = |name| field(&status, name).and_then(|word| word.parse().ok()).unwrap_or(0);
        let is_unlimited = runtime_us.is_some_and(|runtime| runtime < 0);
        let budget = if is_unlimited {
            Budget::NotRestricted
        } else {
            budget(root, kernel.trim(), &proc("self/cgroup"))
        };
        Self {
            kernel: kernel.trim().to_owned(),
            preemption: if is_real_time { Preemption::RealTime } else { preemption(&version) },
            priority_limit: limit(&limits, "Max realtime priority"),
            locked_limit: limit(&limits, "Max locked memory"),
            has_sys_nice: has(CAP_SYS_NICE),
            has_ipc_lock: has(CAP_IPC_LOCK),
            locked_kib: kib("VmLck:"),
            resident_kib: kib("VmRSS:"),
            budget,
            runtime_us,
            period_us: integer(&proc("sys/kernel/sched_rt_period_us")),
            governors: governors(&root.join("sys/devices/system/cpu")),
            isolated_cpus: text(&root.join("sys/devices/system/cpu/isolated")).trim().to_owned(),
        }
    }

    /// Returns how much of its memory the process has locked.
    #[must_use]
    pub const fn locked(&self) -> Locked {
        match self.locked_kib {
            0 => Locked::None,
            locked if locked >= self.resident_kib => Locked::All,
            _ => Locked::Part,
        }
    }

    /// Returns why a thread that requested the SCHED_FIFO priority `wanted` has only `granted`, 0 for none. Empty if it
    /// has what it requested, else at least one reason.
    #[must_use]
    pub fn refusals(&self, wanted: u8, granted: u8) -> Vec<Refusal> {
        if granted >= wanted {
            return Vec::new();
        }
        let mut refusals = Vec::new();
        if !self.has_sys_nice && self.priority_limit < u64::from(wanted) {
            refusals.push(Refusal::NoRight { limit: self.priority_limit });
        }
        // A budget is for all priorities.
        if granted == 0 && self.budget != Budget::NotRestricted {
            refusals.push(Refusal::NoBudget(self.budget.clone()));
        }
        if refusals.is_empty() {
            refusals.push(Refusal::Unknown);
        }
        refusals
    }
}

/// Returns the text of a file, or nothing if it cannot be read.
fn text(path: &Path) -> String {
    let mut bytes = Vec::new();
    let read = File::open(path).and_then(|file| file.take(FILE_BYTES_MAX).read_to_end(&mut bytes));
    // The name of a process may be no UTF-8.
    if read.is_ok() { String::from_utf8_lossy(&bytes).into_owned() } else { String::new() }
}

fn integer(text: &str) -> Option<i64> {
    text.trim().parse().ok()
}

/// Returns the first word after `name` at the start of a line.
fn field<'a>(text: &'a str, name: &str) -> Option<&'a str> {
    text.lines().find_map(|line| line.strip_prefix(name))?.split_whitespace().next()
}

/// Returns the soft limit of this name in the text of `/proc/self/limits`; 0 if it is not there.
fn limit(text: &str, name: &str) -> u64 {
    match field(text, name) {
        Some("unlimited") => u64::MAX,
        Some(word) => word.parse().unwrap_or(0),
        None => 0,
    }
}

fn preemption(version: &str) -> Preemption {
    let has = |word: &str| version.split_whitespace().any(|found| found == word);
    if has("PREEMPT_RT") {
        Preemption::RealTime
    } else if has("PREEMPT_DYNAMIC") {
        Preemption::Dynamic
    } else if has("PREEMPT") {
        Preemption::Full
    } else {
        Preemption::Unknown
    }
}

fn governors(cpus: &Path) -> BTreeSet<String> {
    let entries = fs::read_dir(cpus).into_iter().flatten().flatten().take(CPUS_MAX);
    let governors = entries.map(|cpu| text(&cpu.path().join("cpufreq/scaling_governor")));
    governors.map(|governor| governor.trim().to_owned()).filter(|governor| !governor.is_empty()).collect()
}

/// Returns the budget of the groups that `/proc/self/cgroup` names.
fn budget(root: &Path, kernel: &str, groups: &str) -> Budget {
    let lines = || groups.lines().filter_map(|line| line.split_once(':')?.1.split_once(':'));
    let mounts = root.join("sys/fs/cgroup");
    let of_v1 = lines().find(|(controllers, _)| controllers.split(',').any(|one| one == "cpu"));
    if let Some((controllers, group)) = of_v1 {
        return budget_v1(&[mounts.join(controllers), mounts.join("cpu")], group);
    }
    match lines().find(|(controllers, _)| controllers.is_empty()) {
        Some((_, group)) if has_cpu_controller(&mounts, group) => budget_v2(root, kernel, group),
        Some(_) | None => Budget::NotRestricted,
    }
}

/// Returns the budget of a group of cgroup v1. In a container the group may be the root of what is mounted.
fn budget_v1(mounts: &[PathBuf], group: &str) -> Budget {
    let inside = below_mount(group);
    let places = mounts.iter().flat_map(|mount| [mount.join(&inside), mount.clone()]);
    let found = places.map(|place| place.join("cpu.rt_runtime_us")).find_map(|file| {
        let runtime = integer(&text(&file))?;
        Some((file, runtime))
    });
    match found {
        Some((file, 0)) => Budget::NoneV1 { group: group.to_owned(), file },
        // Without the file the kernel has no budgets.
        Some(_) | None => Budget::NotRestricted,
    }
}

/// Returns whether a group of cgroup v2, or one above it, has the controller `cpu`. The host's root group never has
/// this file.
fn has_cpu_controller(mount: &Path, group: &str) -> bool {
    below_mount(group).ancestors().any(|place| mount.join(place).join("cpu.max").exists())
}

fn budget_v2(root: &Path, kernel: &str, group: &str) -> Budget {
    let group = group.to_owned();
    let command_line = text(&root.join("proc/cmdline"));
    let on_command_line = |value: &str| {
        command_line.split_whitespace().any(|word| word.strip_prefix("rt_group_sched=") == Some(value))
    };
    let config = text(&root.join(format!("boot/config-{kernel}")));
    let is_set = |key: &str| config.lines().any(|line| line.strip_prefix(key) == Some("=y"));
    if on_command_line("0") || (is_set("CONFIG_RT_GROUP_SCHED_DEFAULT_DISABLED") && !on_command_line("1")) {
        return Budget::NotRestricted;
    }
    if config.is_empty() {
        return Budget::MaybeNoneV2 { group };
    }
    if is_set("CONFIG_RT_GROUP_SCHED") { Budget::NoneV2 { group } } else { Budget::NotRestricted }
}

/// Returns the path of a group below its mount. A group outside of the process's namespace has none (`/../..`): it is
/// the root of what is mounted.
fn below_mount(group: &str) -> PathBuf {
    let parts = || Path::new(group).components();
    let is_outside = parts().any(|part| part == Component::ParentDir);
    if is_outside { PathBuf::new() } else { parts().filter(|part| *part != Component::RootDir).collect() }
}

#[cfg(test)]
mod tests;
