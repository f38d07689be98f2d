//! The result of the presses.

use std::fmt;

use serde_json::json;
use sinew_testkit::report::Times;

use super::NODES;

/// Violations that are shown. All are counted.
const SHOWN_MAX: usize = 20;

/// The result of a run.
#[derive(Debug, Default)]
pub struct Report {
    /// The seed of the run.
    pub seed: u64,
    /// Number of presses.
    pub presses: u32,
    /// Time from the press until the output of each node was safe.
    pub safe: [Times; NODES],
    /// Time from the press until the presser's node had the confirmation of each node.
    pub confirmed: [Times; NODES],
    /// Time from the press until the output of a node that was cut off was safe, by its own watchdog.
    pub cut_off: Times,
    /// The times that the answers stated for these nodes.
    pub bounds: Times,
    violations: Vec<String>,
    violation_count: u32,
}

impl Report {
    pub(super) fn new(seed: u64) -> Self {
        Self { seed, ..Self::default() }
    }

    /// Notes a violation, if this does not hold.
    pub(super) fn claim(&mut self, holds: bool, violation: impl FnOnce() -> String) {
        if holds {
            return;
        }
        self.violation_count += 1;
        if self.violations.len() < SHOWN_MAX {
            self.violations.push(format!("press {}: {}", self.presses, violation()));
        }
    }

    /// Returns whether every press reached all nodes that it could reach, and the others were safe in time.
    #[must_use]
    pub const fn holds(&self) -> bool {
        self.presses > 0 && self.violation_count == 0
    }

    /// All figures as one line of JSON.
    #[must_use]
    pub fn json(&self) -> serde_json::Value {
        let all = |times: &[Times; NODES]| times.iter().map(Times::json).collect::<Vec<_>>();
        json!({
            "bench": "stops", "seed": self.seed, "presses": self.presses, "violations": self.violation_count,
            "safe": all(&self.safe), "confirmed": all(&self.confirmed),
            "cut_off": self.cut_off.json(), "bounds": self.bounds.json(),
        })
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "seed {}: {} presses, {} violations", self.seed, self.presses, self.violation_count)?;
        for violation in &self.violations {
            writeln!(f, "VIOLATION {violation}")?;
        }
        writeln!(f, "{:<44} {:>6} {:>9} {:>9} {:>9}", "", "count", "p50 ms", "p99 ms", "max ms")?;
        for (node, (safe, confirmed)) in self.safe.iter().zip(&self.confirmed).enumerate() {
            writeln!(f, "{:<44} {safe}", format!("node {node}: press to safe output"))?;
            writeln!(f, "{:<44} {confirmed}", format!("node {node}: press to confirmation"))?;
        }
        writeln!(f, "{:<44} {}", "cut off: press to output safe by watchdog", self.cut_off)?;
        write!(f, "{:<44} {}", "cut off: the stated bound", self.bounds)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn run_with_a_violation_does_not_hold() {
        let mut report = Report::new(1);
        assert!(!report.holds());
        report.presses = 1;
        report.claim(true, String::new);
        assert!(report.holds());
        for number in 0..=SHOWN_MAX {
            report.claim(false, || format!("violation {number}"));
        }
        assert!(!report.holds());
        let text = report.to_string();
        assert!(text.contains("21 violations") && text.matches("VIOLATION").count() == SHOWN_MAX, "{text}");
    }
}
