//! The result of the injections.

use std::{fmt, time::Duration};

use serde_json::json;
use sinew_testkit::report::Times;

use super::{DRIVES, Injection, WITHIN};

/// Violations that are shown. All are counted.
const SHOWN_MAX: usize = 20;

/// The result of a run.
#[derive(Debug, Default)]
pub struct Report {
    /// Number of injected conditions.
    pub rounds: u32,
    /// Time from the last command, or from the order, until an output was safe: of each injection and drive.
    pub times: [[Times; DRIVES.len()]; Injection::ALL.len()],
    /// The longest dry run at the start.
    pub dry_run: Option<Duration>,
    violations: Vec<String>,
    violation_count: u32,
}

impl Report {
    /// Notes a violation, if this does not hold.
    pub(super) fn claim(&mut self, holds: bool, violation: impl FnOnce() -> String) {
        if holds {
            return;
        }
        self.violation_count += 1;
        if self.violations.len() < SHOWN_MAX {
            self.violations.push(format!("round {}: {}", self.rounds, violation()));
        }
    }

    /// Returns whether every output was safe in time, and each condition was measured that was injected.
    #[must_use]
    pub fn holds(&self) -> bool {
        let injected = self.times.iter().take(self.rounds as usize);
        let are_measured = injected.flatten().all(|times| times.count() > 0);
        self.rounds > 0 && self.violation_count == 0 && are_measured
    }

    /// All figures as one line of JSON.
    #[must_use]
    pub fn json(&self) -> serde_json::Value {
        let each = |times: &[Times; DRIVES.len()]| times.iter().map(Times::json).collect::<Vec<_>>();
        let times = self.times.iter().map(each).collect::<Vec<_>>();
        json!({
            "bench": "contracts", "rounds": self.rounds, "violations": self.violation_count,
            "lost": times[Injection::Kill as usize], "paused": times[Injection::Pause as usize],
            "late": times[Injection::Delay as usize],
            "stopped": times[Injection::Leave as usize], "stopped_by_press": times[Injection::Press as usize],
            "within_ms": WITHIN.as_millis() as u64, "dry_run_ms": self.dry_run.map(|time| time.as_secs_f64() * 1e3),
        })
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "{} conditions, {} violations", self.rounds, self.violation_count)?;
        for violation in &self.violations {
            writeln!(f, "VIOLATION {violation}")?;
        }
        writeln!(
            f,
            "{:<52} {:>6} {:>9} {:>9} {:>9}",
            "last command or order to safe output", "count", "p50 ms", "p99 ms", "max ms"
        )?;
        for injection in Injection::ALL {
            let name = match injection {
                Injection::Kill => "lost: its process is killed",
                Injection::Pause => "lost: its process is paused",
                Injection::Delay => "late: the echoes to it are held back",
                Injection::Leave => "stopped: its node stops in order",
                Injection::Press => "stopped: the stop of the system is pressed",
            };
            for (drive, times) in DRIVES.iter().zip(&self.times[injection as usize]) {
                writeln!(f, "{:<52} {times}", format!("{drive}, {name}"))?;
            }
        }
        let dry_run = self.dry_run.map_or_else(|| "none".to_owned(), |time| format!("{time:.1?}"));
        write!(f, "declared: {WITHIN:?}; longest dry run: {dry_run}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn run_with_a_violation_does_not_hold() {
        let mut report = Report::default();
        assert!(!report.holds());
        report.rounds = 2;
        let note = |times: &mut [Times; DRIVES.len()]| times.iter_mut().for_each(|of| of.note(WITHIN));
        note(&mut report.times[0]);
        assert!(!report.holds(), "the second condition was not measured");
        note(&mut report.times[1]);
        assert!(report.holds());
        report.claim(false, || "late".to_owned());
        assert!(!report.holds() && report.to_string().contains("VIOLATION round 2: late"));
    }
}
