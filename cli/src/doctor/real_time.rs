//! `sinew doctor --rt`: how late a thread of this process wakes, and everything that makes it later.

use std::{path::Path, thread, time::Duration};

use rustix::{
    io::Errno,
    mm::{MlockAllFlags, mlockall},
};
use serde_json::{Value, json};
use sinew::{
    protection::SAFE_OUTPUT_PRIORITY,
    real_time::{Band, HostRights, Lateness, LatenessSummary, Locked, Plan, Preemption, Probe, probe},
};

use super::{Check, rights, summary};
use crate::{
    Report,
    table::{Table, time},
};

/// Width of the longest bar of a histogram, in characters.
const BAR: u64 = 50;

/// Measures for `length` with each schedule, and checks the rights.
pub(crate) fn show(length: Duration, is_wide: bool) -> Report {
    let measured = thread::spawn(move || Measured::now(length)).join();
    let Ok(measured) = measured else {
        let panicked = Check::finding("lateness", "the measurement panicked".to_owned(), "report it, please");
        return summary(&[panicked], is_wide);
    };
    // After `mlockall`.
    let host = HostRights::read(Path::new("/"));
    let Report { text: table, mut json, is_fine } = summary(&checks(&host, &measured), is_wide);
    json["real_time"] = json!({
        "period_us": 1_000,
        "preempt_rt": host.preemption == Preemption::RealTime,
        "memory_locked": host.locked() == Locked::All,
        "schedules": measured.probes.iter().map(probe_json).collect::<Vec<_>>(),
    });
    let histograms: String = measured.probes.iter().map(|probe| histogram(probe, is_wide)).collect();
    Report { text: format!("{histograms}{table}"), json, is_fine }
}

/// The measurements: with the ordinary schedule, and with a real-time priority if one is granted.
struct Measured {
    locked: Result<(), Errno>,
    probes: Vec<Probe>,
}

impl Measured {
    /// Measures on the calling thread, which is new.
    fn now(length: Duration) -> Self {
        let locked = mlockall(MlockAllFlags::CURRENT);
        let first = probe(&Plan::new(Some(SAFE_OUTPUT_PRIORITY), length), || true);
        // Without a priority the first one was ordinary.
        let ordinary = (first.granted > 0).then(|| probe(&Plan::new(None, length), || true));
        Self { locked, probes: ordinary.into_iter().chain([first]).collect() }
    }

    /// Returns the priority that was granted, and the lateness with it.
    fn best(&self) -> (u8, LatenessSummary) {
        let best = self.probes.last();
        best.map_or_else(Default::default, |probe| (probe.granted, probe.lateness.summary()))
    }
}

fn checks(host: &HostRights, measured: &Measured) -> Vec<Check> {
    let (granted, lateness) = measured.best();
    vec![
        lateness_check(host, granted, &lateness),
        rights::judged(host, granted),
        rights::locked(measured.locked),
        rights::governor(host),
        kernel(host),
    ]
}

/// A thread that is late by a period or more has missed a turn.
fn lateness_check(host: &HostRights, granted: u8, lateness: &LatenessSummary) -> Check {
    const NAME: &str = "lateness";
    const PERIOD: Duration = Duration::from_millis(1);
    let schedule = schedule(granted);
    let words = format!("{schedule}: {}", percentiles(lateness));
    if lateness.max < PERIOD {
        return Check::fine(NAME, words);
    }
    let mut fixes = Vec::new();
    if granted == 0 {
        fixes.push("a real-time priority first: see `real-time rights`");
    }
    if host.preemption != Preemption::RealTime {
        fixes.push("a kernel with PREEMPT_RT (Debian: sudo apt-get install linux-image-rt-amd64), or preempt=full on the kernel's command line");
    }
    if host.isolated_cpus.is_empty() {
        fixes.push("a CPU for the control loop alone: isolcpus=3 nohz_full=3 rcu_nocbs=3 irqaffinity=0-2 on the kernel's command line, and `on_cpu(3)`");
    }
    fixes.push("no virtual machine, no deep idle states (sudo cpupower idle-set -D 20), no other real-time threads that compute for long");
    Check::finding(NAME, format!("{words}: a loop of 1 kHz misses turns"), fixes.join("\n"))
}

/// Returns information, not a finding: the lateness decides.
fn kernel(host: &HostRights) -> Check {
    let preemption = match host.preemption {
        Preemption::RealTime => "PREEMPT_RT",
        Preemption::Dynamic => "PREEMPT_DYNAMIC, not PREEMPT_RT",
        Preemption::Full => "PREEMPT, not PREEMPT_RT",
        Preemption::Unknown => "neither PREEMPT_RT nor PREEMPT",
    };
    let isolated = match &*host.isolated_cpus {
        "" => "no isolated CPUs".to_owned(),
        cpus => format!("isolated CPUs {cpus}"),
    };
    Check::fine("kernel", format!("Linux {}, {preemption}; {isolated}", host.kernel))
}

fn schedule(granted: u8) -> String {
    if granted == 0 { "ordinary schedule".to_owned() } else { format!("SCHED_FIFO {granted}") }
}

fn percentiles(lateness: &LatenessSummary) -> String {
    let LatenessSummary { turns, p50, p99, p999, max } = *lateness;
    let [p50, p99, p999, max] = [p50, p99, p999, max].map(|lateness| time(micros(lateness)));
    format!("{turns} turns, p50 {p50}, p99 {p99}, p99.9 {p999}, max {max}")
}

/// Returns the percentiles and the histogram of a measurement, a line for each band.
fn histogram(probe: &Probe, is_wide: bool) -> String {
    let heading =
        format!("Lateness, {}: {}\n", schedule(probe.granted), percentiles(&probe.lateness.summary()));
    format!("{heading}{}\n", bars(&probe.lateness, is_wide))
}

fn bars(lateness: &Lateness, is_wide: bool) -> String {
    let bands = lateness.bands();
    let most = bands.iter().map(|band| band.turns).max().unwrap_or(0).max(1);
    let mut table = Table::new(["UP TO", "TURNS", ""]).wide(is_wide);
    for Band { up_to, turns } in bands {
        // A single turn among many is visible.
        let length = (turns * BAR).div_ceil(most);
        table.row([time(micros(up_to)), turns.to_string(), "#".repeat(usize::try_from(length).unwrap_or(0))]);
    }
    table.text()
}

fn micros(time: Duration) -> u64 {
    u64::try_from(time.as_micros()).unwrap_or(u64::MAX)
}

fn probe_json(probe: &Probe) -> Value {
    let LatenessSummary { turns, p50, p99, p999, max } = probe.lateness.summary();
    let [p50, p99, p999, max] =
        [p50, p99, p999, max].map(|lateness| u64::try_from(lateness.as_nanos()).unwrap_or(u64::MAX));
    let band = |band: Band| json!({ "up_to_us": micros(band.up_to), "turns": band.turns });
    json!({
        "schedule": if probe.granted > 0 { "fifo" } else { "other" },
        "priority": probe.granted,
        "turns": turns,
        "p50_ns": p50,
        "p99_ns": p99,
        "p999_ns": p999,
        "max_ns": max,
        "histogram": probe.lateness.bands().into_iter().map(band).collect::<Vec<_>>(),
    })
}

#[cfg(test)]
mod tests {
    use super::*;

    fn of(us: &[u64]) -> Lateness {
        let mut lateness = Lateness::new();
        us.iter().for_each(|us| lateness.record(Duration::from_micros(*us)));
        lateness
    }

    fn host() -> HostRights {
        HostRights::read(Path::new("/nowhere"))
    }

    #[test]
    fn missed_turn_is_reported_with_the_remaining_fixes() {
        let late = of(&[30, 1_000]).summary();
        let found = lateness_check(&host(), 0, &late);
        assert!(found.detail.starts_with("ordinary schedule: 2 turns, p50 30 us"), "{}", found.detail);
        let fix = found.fix.expect("a finding");
        assert!(["priority first", "PREEMPT_RT", "isolcpus"].iter().all(|part| fix.contains(part)), "{fix}");
        let prepared =
            HostRights { preemption: Preemption::RealTime, isolated_cpus: "3".to_owned(), ..host() };
        let fix = lateness_check(&prepared, 90, &late).fix.expect("a finding");
        assert!(["priority first", "PREEMPT_RT", "isolcpus"].iter().all(|part| !fix.contains(part)), "{fix}");
        assert!(lateness_check(&host(), 90, &of(&[999]).summary()).fix.is_none());
    }

    #[test]
    fn histogram_has_a_bar_for_each_band() {
        let mut us = vec![40; 1_000];
        us.push(300);
        let shown = bars(&of(&us), false);
        let lines: Vec<_> = shown.lines().map(|line| line.split_whitespace().collect::<Vec<_>>()).collect();
        assert_eq!(lines[1], ["50", "us", "1000", &*"#".repeat(50)]);
        assert_eq!(lines[lines.len() - 1], ["500", "us", "1", "#"]);
        assert_eq!(lines.len(), 5, "100 us and 200 us have a line, too: {shown}");
    }

    #[test]
    fn json_has_every_turn_once() {
        let found = probe_json(&Probe { granted: 90, lateness: of(&[3, 40, 40]) });
        assert_eq!(
            (&found["schedule"], &found["priority"], &found["turns"]),
            (&json!("fifo"), &json!(90), &json!(3))
        );
        let turns: u64 =
            found["histogram"].as_array().unwrap().iter().filter_map(|band| band["turns"].as_u64()).sum();
        assert_eq!((turns, &found["max_ns"]), (3, &json!(40_000)));
    }
}
