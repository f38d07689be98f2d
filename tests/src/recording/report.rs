//! Results of a run with recordings.

use std::{fmt, time::Duration};

use serde_json::{Value, json};

use super::{Plan, Sent};

/// A round without a recording, and the next one with one.
#[derive(Clone, Debug)]
pub struct Round {
    /// Without.
    pub without: Sent,
    /// With.
    pub with: Sent,
    /// Messages that are in no file, as the file states it.
    pub dropped: u64,
    /// Sentences: differences between the file and the messages that were sent.
    pub faults: Vec<String>,
}

/// The results.
#[derive(Clone, Debug)]
pub struct Report {
    pub(super) plan: Plan,
    /// The rounds.
    pub rounds: Vec<Round>,
}

/// Returns the median; zero if there are no values.
fn median(values: impl Iterator<Item = Duration>) -> Duration {
    let mut sorted: Vec<_> = values.collect();
    sorted.sort();
    sorted.get(sorted.len() / 2).copied().unwrap_or_default()
}

impl Report {
    /// Returns whether each message is in a file or counted as dropped.
    #[must_use]
    pub fn holds(&self) -> bool {
        self.rounds.iter().all(|round| round.faults.is_empty())
    }

    /// Medians over the rounds of the median and the 99th percentile, without and with a recording.
    #[must_use]
    pub fn medians(&self) -> [[Duration; 2]; 2] {
        let of = |pick: fn(&Round) -> &Sent| {
            let all = || self.rounds.iter().map(pick);
            [median(all().map(|sent| sent.p50)), median(all().map(|sent| sent.p99))]
        };
        [of(|round| &round.without), of(|round| &round.with)]
    }

    /// The median and the 99th percentile with a recording, as multiples of those without.
    #[must_use]
    pub fn ratios(&self) -> [f64; 2] {
        let [without, with] = self.medians();
        [0, 1].map(|at: usize| with[at].as_secs_f64() / without[at].as_secs_f64().max(f64::MIN_POSITIVE))
    }

    /// Machine-readable output in one line.
    #[must_use]
    pub fn json(&self) -> Value {
        let ns = |times: [Duration; 2]| {
            let [p50, p99] = times.map(|time| u64::try_from(time.as_nanos()).unwrap_or(u64::MAX));
            json!({ "p50_ns": p50, "p99_ns": p99 })
        };
        let [without, with] = self.medians();
        let [p50, p99] = self.ratios();
        let sum = |of: fn(&Round) -> u64| self.rounds.iter().map(of).sum::<u64>();
        json!({
            "bench": "recording", "channels": self.plan.sources, "rate": self.plan.load.rate,
            "length": self.plan.load.length, "rounds": self.rounds.len(), "without": ns(without), "with": ns(with),
            "p50_ratio": p50, "p99_ratio": p99, "sent": sum(|round| round.with.total()),
            "dropped": sum(|round| round.dropped), "faults": sum(|round| round.faults.len() as u64),
        })
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let us = |time: Duration| time.as_secs_f64() * 1e6;
        writeln!(
            f,
            "{:<10} {:>10} {:>9} {:>9} {:>9} {:>10} {:>9}",
            "recording", "messages", "p50 us", "p99 us", "max us", "per s", "dropped"
        )?;
        for round in &self.rounds {
            let dropped = round.dropped.to_string();
            for (name, sent, dropped) in [("no", &round.without, "-"), ("yes", &round.with, &*dropped)] {
                let rate = sent.total() as f64 / sent.took.as_secs_f64().max(f64::MIN_POSITIVE);
                writeln!(
                    f,
                    "{name:<10} {:>10} {:>9.2} {:>9.2} {:>9.1} {rate:>10.0} {dropped:>9}",
                    sent.total(),
                    us(sent.p50),
                    us(sent.p99),
                    us(sent.max)
                )?;
            }
            for fault in &round.faults {
                writeln!(f, "FAULT {fault}")?;
            }
        }
        let [p50, p99] = self.ratios();
        write!(f, "with a recording: p50 {p50:.2} times, p99 {p99:.2} times that without")
    }
}
