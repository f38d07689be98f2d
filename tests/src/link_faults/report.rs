//! Results of a run with link faults, as a table and as JSON.

use std::{collections::BTreeMap, fmt, time::Duration};

use serde_json::{Value, json};
use sinew::{Class, audit::Audit};

use super::{CLASSES, Plan, trouble::Trouble};
use sinew_testkit::report::Times;
use sinew_testkit::{history::Verdict, network::Counts};

/// The longest time without a message after one fault.
#[derive(Clone, Copy, Debug)]
pub(super) struct Gap {
    /// Without a message of any class.
    pub(super) all: Duration,
    /// Without a message of each class, in the order of [`CLASSES`].
    pub(super) each: [Duration; 3],
}

impl Gap {
    /// The same gap for all classes.
    pub(super) const fn of_all(gap: Duration) -> Self {
        Self { all: gap, each: [gap; 3] }
    }
}

/// The longest times without a message, by kind of fault.
#[derive(Clone, Debug, Default)]
pub(super) struct Gaps(BTreeMap<Trouble, Row>);

#[derive(Clone, Debug, Default)]
struct Row {
    all: Times,
    each: [Times; 3],
}

impl Gaps {
    pub(super) fn note(&mut self, trouble: Trouble, gap: Gap) {
        let row = self.0.entry(trouble).or_default();
        row.all.note(gap.all);
        row.each.iter_mut().zip(gap.each).for_each(|(times, gap)| times.note(gap));
    }

    fn json(&self) -> Value {
        let rows = self.0.iter().map(|(trouble, row)| {
            let mut json = row.all.json();
            for (class, times) in CLASSES.into_iter().zip(&row.each) {
                json[name(class)] = times.json();
            }
            (trouble.to_string(), json)
        });
        rows.collect::<BTreeMap<_, _>>().into_iter().collect()
    }
}

fn name(class: Class) -> String {
    format!("{class:?}").to_lowercase()
}

impl fmt::Display for Gaps {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(f, "{:<16} {:>6} {:>9} {:>9} {:>9}", "longest gap", "faults", "p50 ms", "p99 ms", "max ms")?;
        for (trouble, Row { all, each }) in &self.0 {
            write!(f, "\n{trouble:<16} {all}")?;
            for (class, times) in CLASSES.into_iter().zip(each) {
                write!(f, "\n  of {:<11} {times}", name(class))?;
            }
        }
        Ok(())
    }
}

/// The results.
#[derive(Debug)]
pub struct Report {
    pub(super) plan: Plan,
    pub(super) seconds: f64,
    /// The fates of the messages.
    pub verdict: Verdict,
    /// The counters of the network.
    pub network: Counts,
    pub(super) gaps: Gaps,
    /// The nodes' own audit of all messages, at the end.
    pub audit: Audit,
}

impl Report {
    /// Returns whether no message was lost silently, duplicated, reordered or reported falsely. If no node
    /// was lost, every message must have arrived. The nodes must be able to explain every message.
    #[must_use]
    pub fn holds(&self) -> bool {
        if self.audit.missing() > 0 {
            return false;
        }
        if self.plan.troubles.iter().all(|trouble| trouble.is_short()) {
            self.verdict.is_perfect()
        } else {
            self.verdict.holds()
        }
    }

    /// Machine-readable output in one line.
    #[must_use]
    pub fn json(&self) -> Value {
        let Counts { made, cut, flips, lost, passed, .. } = self.network;
        json!({
            "bench": "link_faults", "holds": self.holds(), "seed": self.plan.seed, "faults": self.plan.faults,
            "rate": self.plan.rate, "back_rate": self.plan.back_rate, "filling": self.plan.filling,
            "unexplained": self.audit.missing(), "seconds": self.seconds, "messages": self.verdict.json(), "gaps": self.gaps.json(),
            "network": {
                "connections": made, "cut": cut, "bits_flipped": flips, "datagrams_lost": lost,
                "bytes_there": passed[1], "bytes_back": passed[0],
            },
        })
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let Self { plan, seconds, verdict, network, gaps, audit } = self;
        let per_second = verdict.sent as f64 / seconds;
        writeln!(
            f,
            "seed {}: {} faults in {seconds:.1} s, {per_second:.0} messages a second; {} connections, {} cut, {} bits flipped",
            plan.seed, plan.faults, network.made, network.cut, network.flips
        )?;
        writeln!(f, "{verdict}")?;
        write!(f, "{gaps}\n{audit}")
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn gaps_are_listed_by_fault_and_class() {
        let mut gaps = Gaps::default();
        let ms = Duration::from_millis;
        gaps.note(Trouble::Cut, Gap { all: ms(1), each: [ms(12), ms(3), ms(15)] });
        gaps.note(Trouble::Cut, Gap { all: ms(2), each: [ms(10), ms(4), ms(2)] });
        gaps.note(Trouble::KillReceiver, Gap::of_all(ms(400)));
        let text = gaps.to_string();
        let rows: Vec<Vec<&str>> = text.lines().skip(1).map(|row| row.split_whitespace().collect()).collect();
        let row = |name: &[&'static str], count, [p50, p99, max]: [&'static str; 3]| {
            name.iter().copied().chain([count, p50, p99, max]).collect::<Vec<_>>()
        };
        let of_kill = |name: &[&'static str]| row(name, "1", ["400.000"; 3]);
        let expected = [
            row(&["cut"], "2", ["1.000", "2.000", "2.000"]),
            row(&["of", "control"], "2", ["10.000", "12.000", "12.000"]),
            row(&["of", "stream"], "2", ["3.000", "4.000", "4.000"]),
            row(&["of", "bulk"], "2", ["2.000", "15.000", "15.000"]),
            of_kill(&["kill-receiver"]),
            of_kill(&["of", "control"]),
            of_kill(&["of", "stream"]),
            of_kill(&["of", "bulk"]),
        ];
        assert_eq!(rows, expected, "{text}");
        let json = gaps.json();
        assert_eq!(json["cut"]["max_ms"], 2.0);
        assert_eq!(json["cut"]["control"]["max_ms"], 12.0);
        assert_eq!(json["kill-receiver"]["bulk"]["count"], 1);
    }
}
