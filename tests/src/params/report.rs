//! The result of the transactions.

use std::fmt;

use serde_json::json;
use sinew_testkit::report::Times;

/// Violations that are shown. All are counted.
const SHOWN_MAX: usize = 20;

/// The result of a run.
#[derive(Debug, Default)]
pub struct Report {
    /// The seed of the run.
    pub seed: u64,
    /// Number of transactions with a fault.
    pub rounds: u32,
    /// Transactions that all nodes have applied, the killed one before its end.
    pub complete: u32,
    /// Transactions that no node has applied.
    pub without_effect: u32,
    /// Transactions of which the killed node got the values after its restart.
    pub repaired: u32,
    /// Transactions without their coordinator, which was killed. The living nodes have all applied them, or none.
    pub coordinators_killed: u32,
    /// Of these, those that the others have applied, and that the coordinator's node had kept before it was killed.
    pub kept: u32,
    /// The same, if that node had not kept it: it was killed in the first milliseconds after its acceptance.
    pub behind: u32,
    /// Transactions in which a node was cut off.
    pub cuts: u32,
    /// Time from the first to the last tick at which living nodes applied a transaction.
    pub spread: Times,
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
            self.violations.push(format!("round {}: {}", self.rounds, violation()));
        }
    }

    /// Returns whether each transaction was applied by all living nodes or by none, and its answer was true.
    #[must_use]
    pub const fn holds(&self) -> bool {
        self.rounds > 0 && self.violation_count == 0
    }

    /// All figures as one line of JSON.
    #[must_use]
    pub fn json(&self) -> serde_json::Value {
        json!({
            "bench": "params", "seed": self.seed, "rounds": self.rounds, "violations": self.violation_count,
            "complete": self.complete, "without_effect": self.without_effect, "repaired": self.repaired,
            "coordinators_killed": self.coordinators_killed, "kept": self.kept, "behind": self.behind,
            "cuts": self.cuts, "spread": self.spread.json(),
        })
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(f, "seed {}: {} transactions, {} violations", self.seed, self.rounds, self.violation_count)?;
        for violation in &self.violations {
            writeln!(f, "VIOLATION {violation}")?;
        }
        let counts = [
            ("a node was killed: applied by all", self.complete),
            ("a node was killed: applied by none", self.without_effect),
            ("a node was killed: repaired after its restart", self.repaired),
            ("the coordinator's node was killed", self.coordinators_killed),
            ("  and begins with the value of the others", self.kept),
            ("  and begins with its former value", self.behind),
            ("a node was cut off", self.cuts),
        ];
        for (case, count) in counts {
            writeln!(f, "{case:<48} {count:>6}")?;
        }
        writeln!(f, "{:<48} {:>6} {:>9} {:>9} {:>9}", "", "count", "p50 ms", "p99 ms", "max ms")?;
        write!(f, "{:<48} {}", "first to last tick of a transaction", self.spread)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn run_with_a_violation_does_not_hold() {
        let mut report = Report::new(1);
        assert!(!report.holds());
        report.rounds = 1;
        report.claim(true, String::new);
        assert!(report.holds());
        report.claim(false, || "mixed".to_owned());
        assert!(!report.holds() && report.to_string().contains("VIOLATION round 1: mixed"));
    }
}
