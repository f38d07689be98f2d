//! CPU times, as the kernel reports them in `/proc`.

use std::collections::BTreeMap;
use std::fs;

/// The unit of CPU times in `/proc`; the same on every architecture that Linux shows to programs today.
const CLOCK_TICKS_PER_S: f64 = 100.0;

/// Time of a sample, ns of the host's monotonic clock, and the CPU seconds that each process had used.
pub type CpuTimes = (u64, BTreeMap<&'static str, f64>);

/// CPU seconds that a process has used. From `/proc/PID/stat`: user and system time, the 14th and 15th
/// fields; the second is the name, in parentheses.
#[must_use]
pub fn process_seconds(id: u32) -> Option<f64> {
    let text = fs::read_to_string(format!("/proc/{id}/stat")).ok()?;
    let after_name = text.rsplit_once(')')?.1;
    let mut fields = after_name.split_ascii_whitespace().skip(11);
    let ticks = |field: Option<&str>| field?.parse::<f64>().ok();
    Some((ticks(fields.next())? + ticks(fields.next())?) / CLOCK_TICKS_PER_S)
}

/// CPU time of the whole machine since its start, hundredths of a second of all its CPUs.
#[derive(Debug, Clone, Copy, Default, PartialEq)]
pub struct HostCpu {
    /// Total, idle time included.
    pub total: f64,
    /// Used by programs and the kernel.
    pub busy: f64,
    /// Taken by the hypervisor, if it reports that.
    pub stolen: f64,
}

impl HostCpu {
    /// Reads the current `/proc/stat`.
    #[must_use]
    pub fn now() -> Option<Self> {
        Self::parse(&fs::read_to_string("/proc/stat").ok()?)
    }

    /// user, nice, system, idle, iowait, irq, softirq, steal.
    fn parse(text: &str) -> Option<Self> {
        let fields = text.lines().next()?.strip_prefix("cpu ")?.split_ascii_whitespace();
        let ticks: Vec<f64> = fields.take(8).map_while(|field| field.parse().ok()).collect();
        let [user, nice, system, idle, iowait, irq, softirq, stolen] = ticks.try_into().ok()?;
        let busy = user + nice + system + irq + softirq;
        Some(Self { total: busy + idle + iowait + stolen, busy, stolen })
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn process_cpu_time_is_read() {
        assert!(process_seconds(std::process::id()).is_some_and(|seconds| seconds < 10_000.0));
        assert_eq!(process_seconds(u32::MAX), None);
    }

    #[test]
    fn machine_cpu_time_is_read() {
        let text = "cpu  1 2 3 40 5 6 7 8 9 10\ncpu0 1 2 3\n";
        assert_eq!(HostCpu::parse(text), Some(HostCpu { total: 72.0, busy: 19.0, stolen: 8.0 }));
        assert_eq!(HostCpu::parse("intr 1"), None);
        assert!(HostCpu::now().is_some_and(|cpu| cpu.total > 0.0));
    }
}
