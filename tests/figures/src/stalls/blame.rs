//! Decides whether the host or the measured program itself caused a stall.
//!
//! The rule: a witness is late because other threads had its CPU, or because the CPU itself did not run. That
//! is a stall of the host: another program's load, or a hypervisor that ran something else. It is the
//! program's own stall in three cases:
//!
//! 1. Its processes used more than nine tenths of the time of all CPUs around it.
//! 2. One of its processes used more CPU time than its ticks last, in the two seconds around it or in the
//!    whole run. Such a loop would not keep its period with a CPU of its own either, regardless of other
//!    load on the host.
//! 3. The same in the samples next to the stall, a fifth of a second each, where another CPU ran its witness
//!    in time. Where no CPU did, the whole machine stood still, and a hypervisor may have charged that to the
//!    process that happened to run.
//!
//! CPU time is the time that the kernel has charged to the processes, so that waiting for a CPU does not
//! count as use.

use super::cpu::CpuTimes;
use super::witness::{CpuStall, Testimony};

/// Share of all CPUs above which the program is the load.
const SHARE_MAX: f64 = 0.9;
/// Half of the window around a stall in which a loop that never keeps its period is judged, ns.
const AROUND_NS: u64 = 1_000_000_000;
/// The kernel reports CPU times in hundredths of a second, for user and system time each: reading error,
/// seconds.
const READING_S: f64 = 0.02;
/// Time of one tick, seconds.
const TICK_S: f64 = 1e-3;

/// The input of a judgement.
#[derive(Debug)]
pub struct Evidence<'a> {
    /// CPU times of the program's processes, rising in time.
    pub samples: &'a [CpuTimes],
    /// Tick times of each loop, rising, by the name of its process. A tick lasts a millisecond.
    pub ticks: Vec<(&'static str, Vec<u64>)>,
    /// CPUs of the machine that the program may use.
    pub cpus: usize,
    /// Start of the ticks: before it, starting processes use CPU time without ticks.
    pub ticks_from_ns: u64,
}

/// Stalls that overlap, on any CPU, as one.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub struct HostStall {
    /// From the first of them to the last.
    pub at: CpuStall,
    /// Whether each CPU stalled at some time in it.
    pub everywhere: bool,
}

/// Merges the stalls of all CPUs.
#[must_use]
pub fn merged(testimonies: &[Testimony]) -> Vec<HostStall> {
    let mut all: Vec<(CpuStall, usize)> = testimonies
        .iter()
        .enumerate()
        .flat_map(|(cpu, testimony)| testimony.stalls.iter().map(move |stall| (*stall, cpu)))
        .collect();
    all.sort_by_key(|(stall, _)| stall.from_ns);
    let mut merged: Vec<(CpuStall, Vec<usize>)> = Vec::new();
    for (stall, cpu) in all {
        match merged.last_mut() {
            Some((last, cpus)) if stall.from_ns <= last.to_ns => {
                last.to_ns = last.to_ns.max(stall.to_ns);
                if !cpus.contains(&cpu) {
                    cpus.push(cpu);
                }
            }
            Some(_) | None => merged.push((stall, vec![cpu])),
        }
    }
    let everywhere = |cpus: &[usize]| cpus.len() == testimonies.len();
    merged.into_iter().map(|(at, cpus)| HostStall { at, everywhere: everywhere(&cpus) }).collect()
}

impl Evidence<'_> {
    /// Whether the program has caused this stall itself.
    #[must_use]
    pub fn is_own(&self, stall: &HostStall) -> bool {
        let CpuStall { from_ns, to_ns } = stall.at;
        let near = self.between(from_ns, to_ns);
        if self.fills_the_machine(near) {
            return true;
        }
        if to_ns < self.ticks_from_ns {
            return false;
        }
        let run = self.between(self.ticks_from_ns, u64::MAX);
        let around = self.between(
            from_ns.saturating_sub(AROUND_NS).max(self.ticks_from_ns),
            to_ns.saturating_add(AROUND_NS),
        );
        self.overruns(run) || self.overruns(around) || (!stall.everywhere && self.overruns(near))
    }

    /// Indices of the last sample before `from_ns` and of the first one after `to_ns`.
    fn between(&self, from_ns: u64, to_ns: u64) -> (usize, usize) {
        let before = self.samples.partition_point(|(at_ns, _)| *at_ns <= from_ns).saturating_sub(1);
        let after = self.samples.partition_point(|(at_ns, _)| *at_ns < to_ns);
        (before, after.min(self.samples.len().saturating_sub(1)))
    }

    fn fills_the_machine(&self, (first, last): (usize, usize)) -> bool {
        let Some(seconds) = self.seconds(first, last) else { return false };
        let names = self.samples[last].1.keys();
        let used: f64 = names.map(|name| self.used(name, first, last)).sum();
        used - READING_S > SHARE_MAX * self.cpus as f64 * seconds
    }

    /// Whether a loop used more CPU time than its ticks last.
    fn overruns(&self, (first, last): (usize, usize)) -> bool {
        if self.seconds(first, last).is_none() {
            return false;
        }
        let (from_ns, to_ns) = (self.samples[first].0, self.samples[last].0);
        self.ticks.iter().any(|(name, at_ns)| {
            let ticks = at_ns.partition_point(|at| *at <= to_ns) - at_ns.partition_point(|at| *at <= from_ns);
            self.used(name, first, last) > ticks as f64 * TICK_S + READING_S
        })
    }

    fn seconds(&self, first: usize, last: usize) -> Option<f64> {
        (first < last).then(|| (self.samples[last].0 - self.samples[first].0) as f64 * 1e-9)
    }

    /// CPU seconds of a process between two samples. A restarted process began at zero.
    fn used(&self, name: &str, first: usize, last: usize) -> f64 {
        let at = |sample: usize| self.samples[sample].1.get(name).copied();
        at(last).map_or(0.0, |used| used - at(first).filter(|before| *before <= used).unwrap_or(0.0))
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeMap;

    use super::*;

    const MS: u64 = 1_000_000;

    /// Ten seconds of two CPUs, in which the knee's process uses this share of one, with this many ticks per
    /// millisecond.
    fn evidence(samples: &[CpuTimes], ticks_per_ms: f64) -> Evidence<'_> {
        let ticks = (0..(10_000.0 * ticks_per_ms) as u64).map(|n| (n as f64 / ticks_per_ms) as u64 * MS);
        Evidence { samples, ticks: vec![("knee", ticks.collect())], cpus: 2, ticks_from_ns: 0 }
    }

    fn samples(cpu_share: f64) -> Vec<CpuTimes> {
        let at = |n: u32| u64::from(n) * 200 * MS;
        let used = |n: u32| (0.2 * f64::from(n) * cpu_share * 100.0).floor() / 100.0;
        (0..=50).map(|n| (at(n), BTreeMap::from([("knee", used(n))]))).collect()
    }

    fn stall(everywhere: bool) -> HostStall {
        HostStall { at: CpuStall { from_ns: 5_000 * MS, to_ns: 5_040 * MS }, everywhere }
    }

    #[test]
    fn stall_beside_an_idle_robot_is_the_hosts() {
        let samples = samples(0.4);
        // Even if it has lost most of its ticks to other load.
        for ticks_per_ms in [1.0, 0.6] {
            let evidence = evidence(&samples, ticks_per_ms);
            assert!(!evidence.is_own(&stall(true)) && !evidence.is_own(&stall(false)));
        }
    }

    #[test]
    fn overlong_loop_is_the_robots_own_stall() {
        // With a CPU to itself, and with a third of one beside other load.
        for cpu_share in [1.0, 0.33] {
            let samples = samples(cpu_share);
            let evidence = evidence(&samples, cpu_share / 5.0);
            assert!(evidence.is_own(&stall(true)) && evidence.is_own(&stall(false)), "{cpu_share}");
        }
    }

    #[test]
    fn robot_that_fills_all_cpus_causes_its_own_stall() {
        let samples = samples(1.95);
        // Its loop would keep its period.
        let evidence = evidence(&samples, 2.0);
        assert!(evidence.is_own(&stall(true)));
    }

    #[test]
    fn cpu_time_charged_during_a_freeze_is_no_overload() {
        // given: 150 ms in which the knee's process ran, according to the kernel, and did not tick
        let mut samples = samples(0.1);
        samples.iter_mut().skip(26).for_each(|(_, used)| *used.get_mut("knee").expect("it is there") += 0.15);
        let mut evidence = evidence(&samples, 1.0);
        evidence.ticks[0].1.retain(|at| !(5_000 * MS..5_150 * MS).contains(at));
        // then: it is the host's, but the robot's own if another CPU kept running
        assert!(!evidence.is_own(&stall(true)));
        evidence.ticks[0].1.retain(|at| !(5_000 * MS..5_200 * MS).contains(at));
        assert!(evidence.is_own(&stall(false)));
    }

    #[test]
    fn overlapping_stalls_merge_and_record_running_cpus() {
        let seen = |stalls: &[(u64, u64)]| Testimony {
            stalls: stalls
                .iter()
                .map(|(from_ns, to_ns)| CpuStall { from_ns: *from_ns, to_ns: *to_ns })
                .collect(),
            ..Testimony::default()
        };
        let merged = merged(&[seen(&[(10, 20), (50, 60)]), seen(&[(15, 30)])]);
        let at = |from_ns, to_ns| CpuStall { from_ns, to_ns };
        assert_eq!(
            merged,
            [HostStall { at: at(10, 30), everywhere: true }, HostStall { at: at(50, 60), everywhere: false }]
        );
    }
}
