//! The rights that are read from folders with the files of a kernel.

use std::sync::atomic::{AtomicU32, Ordering};

use super::*;

const LIMITS: &str = "Limit                     Soft Limit           Hard Limit           Units     \n\
                      Max locked memory         8388608              8388608              bytes     \n\
                      Max realtime priority     40                   99                             \n\
                      Max realtime timeout      unlimited            unlimited            us        \n";
const STATUS: &str = "Name:\tknee\nVmLck:\t    2048 kB\nVmRSS:\t    4096 kB\nCapInh:\t0000000000000000\nCapEff:\t0000000000004000\n";

/// A folder in place of `/`, which is removed at its end.
struct Root(PathBuf);

impl Root {
    fn new() -> Self {
        static NUMBER: AtomicU32 = AtomicU32::new(0);
        let number = NUMBER.fetch_add(1, Ordering::Relaxed);
        let root = std::env::temp_dir().join(format!("sinew-rights-{}-{number}", std::process::id()));
        fs::create_dir(&root).unwrap();
        Self(root)
    }

    fn with(self, file: &str, text: &str) -> Self {
        let path = self.0.join(file);
        fs::create_dir_all(path.parent().unwrap()).unwrap();
        fs::write(path, text).unwrap();
        self
    }

    fn rights(&self) -> HostRights {
        HostRights::read(&self.0)
    }
}

impl Drop for Root {
    fn drop(&mut self) {
        let _ = fs::remove_dir_all(&self.0);
    }
}

/// A process in the group `/robot` of cgroup v2 with the controller `cpu`.
fn in_group_v2() -> Root {
    let root = Root::new().with("proc/self/cgroup", "0::/robot/knee\n");
    root.with("sys/fs/cgroup/robot/cpu.max", "max 100000\n").with("proc/sys/kernel/osrelease", "6.12.1\n")
}

#[test]
fn limits_capabilities_and_memory_are_read() {
    let root = Root::new().with("proc/self/limits", LIMITS).with("proc/self/status", STATUS);
    let rights = root.rights();
    assert_eq!((rights.priority_limit, rights.locked_limit), (40, 8 << 20));
    assert_eq!((rights.has_sys_nice, rights.has_ipc_lock), (false, true));
    assert_eq!((rights.locked_kib, rights.resident_kib, rights.locked()), (2_048, 4_096, Locked::Part));
    let unlimited = LIMITS.replace("8388608 ", "unlimited ").replace("40 ", "unlimited ");
    let status = STATUS.replace("2048 kB", "4096 kB").replace("0000004000", "0000800000");
    let rights = root.with("proc/self/limits", &unlimited).with("proc/self/status", &status).rights();
    assert_eq!((rights.priority_limit, rights.locked_limit), (u64::MAX, u64::MAX));
    assert_eq!((rights.has_sys_nice, rights.has_ipc_lock, rights.locked()), (true, false, Locked::All));
}

#[test]
fn host_without_files_has_neither_rights_nor_refusing_budget() {
    let rights = Root::new().rights();
    assert_eq!((rights.priority_limit, rights.locked_limit, rights.locked()), (0, 0, Locked::None));
    assert_eq!((rights.budget, rights.preemption), (Budget::NotRestricted, Preemption::Unknown));
    assert_eq!((rights.runtime_us, rights.governors.len(), rights.has_sys_nice), (None, 0, false));
}

#[test]
fn kernel_is_described() {
    let of = |version: &str| Root::new().with("proc/version", version).rights().preemption;
    assert_eq!(of("Linux version 6.12.1 (gcc) #1 SMP PREEMPT_RT Debian"), Preemption::RealTime);
    assert_eq!(of("Linux version 6.12.1 (gcc) #1 SMP PREEMPT_DYNAMIC @0"), Preemption::Dynamic);
    assert_eq!(of("Linux version 5.4.0 (gcc) #1 SMP PREEMPT Mon"), Preemption::Full);
    assert_eq!(of("Linux version 5.4.0 (gcc) #1 SMP Mon"), Preemption::Unknown);
    let root = Root::new().with("sys/kernel/realtime", "1\n").with("proc/sys/kernel/osrelease", "6.1-rt\n");
    let root = root.with("sys/devices/system/cpu/isolated", "2-3\n");
    let root = root.with("sys/devices/system/cpu/cpu0/cpufreq/scaling_governor", "powersave\n");
    let root = root.with("sys/devices/system/cpu/cpu1/cpufreq/scaling_governor", "performance\n");
    let rights = root
        .with("proc/sys/kernel/sched_rt_runtime_us", "950000\n")
        .with("proc/sys/kernel/sched_rt_period_us", "1000000\n")
        .rights();
    assert_eq!((rights.preemption, &*rights.kernel), (Preemption::RealTime, "6.1-rt"));
    assert_eq!(&*rights.isolated_cpus, "2-3");
    assert_eq!(rights.governors.iter().map(String::as_str).collect::<Vec<_>>(), ["performance", "powersave"]);
    assert_eq!((rights.runtime_us, rights.period_us), (Some(950_000), Some(1_000_000)));
}

#[test]
fn group_of_v1_without_a_budget_refuses() {
    let root = Root::new().with("proc/self/cgroup", "4:memory:/a\n3:cpu,cpuacct:/robot\n0::/\n");
    let file = "sys/fs/cgroup/cpu,cpuacct/robot/cpu.rt_runtime_us";
    assert_eq!(root.rights().budget, Budget::NotRestricted, "such a kernel has no budgets");
    let root = root.with(file, "0\n");
    let none = Budget::NoneV1 { group: "/robot".to_owned(), file: root.0.join(file) };
    assert_eq!(root.rights().budget, none);
    let root = root.with(file, "950000\n");
    assert_eq!(root.rights().budget, Budget::NotRestricted);
}

#[test]
fn container_of_v1_reads_the_budget_at_its_mount() {
    let root = Root::new().with("proc/self/cgroup", "3:cpu:/docker/0123\n");
    let root = root.with("sys/fs/cgroup/cpu/cpu.rt_runtime_us", "0\n");
    assert!(matches!(root.rights().budget, Budget::NoneV1 { group, .. } if group == "/docker/0123"));
}

#[test]
fn group_of_v2_refuses_where_the_kernel_has_budgets() {
    let group = "/robot/knee".to_owned();
    let root = in_group_v2();
    assert_eq!(root.rights().budget, Budget::MaybeNoneV2 { group: group.clone() });
    let root = root.with("boot/config-6.12.1", "CONFIG_CGROUPS=y\n# CONFIG_RT_GROUP_SCHED is not set\n");
    assert_eq!(root.rights().budget, Budget::NotRestricted);
    let root = root.with("boot/config-6.12.1", "CONFIG_CGROUPS=y\nCONFIG_RT_GROUP_SCHED=y\n");
    assert_eq!(root.rights().budget, Budget::NoneV2 { group });
    let root = root.with("proc/cmdline", "quiet rt_group_sched=0\n");
    assert_eq!(root.rights().budget, Budget::NotRestricted);
}

#[test]
fn group_v2_without_controller_or_namespace_shares_root_budget() {
    let root = Root::new().with("proc/self/cgroup", "0::/robot/knee\n");
    assert_eq!(root.rights().budget, Budget::NotRestricted, "it shares the root's budget");
    let root = root.with("proc/self/cgroup", "0::/../../etc\n").with("sys/fs/cgroup/etc/cpu.max", "max\n");
    assert_eq!(root.rights().budget, Budget::NotRestricted, "no path leaves the mount");
    let root = root.with("sys/fs/cgroup/cpu.max", "max\n");
    assert!(matches!(root.rights().budget, Budget::MaybeNoneV2 { .. }));
}

#[test]
fn no_budget_refuses_where_real_time_is_unlimited() {
    let root = in_group_v2().with("boot/config-6.12.1", "CONFIG_RT_GROUP_SCHED=y\n");
    let root = root.with("proc/sys/kernel/sched_rt_runtime_us", "-1\n");
    assert_eq!(root.rights().budget, Budget::NotRestricted);
}

#[test]
fn every_refusal_has_its_reasons() {
    let root = in_group_v2().with("boot/config-6.12.1", "CONFIG_RT_GROUP_SCHED=y\n");
    let root = root.with("proc/self/limits", LIMITS);
    let rights = root.rights();
    assert_eq!(rights.refusals(90, 90), []);
    assert_eq!(rights.refusals(90, 40), [Refusal::NoRight { limit: 40 }], "some priority was granted");
    let budget = Refusal::NoBudget(Budget::NoneV2 { group: "/robot/knee".to_owned() });
    assert_eq!(rights.refusals(90, 0), [Refusal::NoRight { limit: 40 }, budget.clone()]);
    assert_eq!(rights.refusals(30, 0), [budget]);
    let rights = HostRights { budget: Budget::NotRestricted, has_sys_nice: true, ..rights };
    assert_eq!(rights.refusals(90, 0), [Refusal::Unknown]);
}

#[test]
fn hostile_files_are_no_rights() {
    for text in
        ["", ":", "::", "0:", "\u{0}", "Max realtime priority", "CapEff:\tzz\nVmLck:\t-1 kB", "3:cpu:"]
    {
        let root = Root::new().with("proc/self/limits", text).with("proc/self/status", text);
        let rights = root.with("proc/self/cgroup", text).rights();
        assert_eq!(
            (rights.priority_limit, rights.has_sys_nice, rights.locked_kib),
            (0, false, 0),
            "{text:?}"
        );
    }
    let root = Root::new();
    fs::create_dir_all(root.0.join("proc/self")).unwrap();
    fs::write(root.0.join("proc/self/limits"), [0xff_u8, 0xfe, 0x00]).unwrap();
    assert_eq!(root.rights().priority_limit, 0);
}
