//! A case beside its reference, as a JSON line.

use serde_json::{Value, json};

use crate::{Figures, round};

/// Round trips of one case, and of the reference that ran right before it.
#[derive(Debug)]
pub struct Beside<'a> {
    /// The bench.
    pub bench: &'a str,
    /// The case.
    pub case: &'a str,
    /// What a message carries, in bytes.
    pub payload_bytes: usize,
    /// Which CPUs the two ends use.
    pub pinning: &'a str,
    /// How round trips follow each other.
    pub pace: &'a str,
    /// The case's times.
    pub seen: &'a Figures,
    /// What it stands beside.
    pub reference: &'a str,
    /// The reference's times.
    pub raw: &'a Figures,
    /// Counts beside the times.
    pub counts: &'a [(&'a str, f64)],
}

impl Beside<'_> {
    /// Prints the head of the table whose rows [`report`](Self::report) prints.
    pub fn head() {
        eprintln!("| case | payload | CPUs | pace | p50 | p99 | p99.9 | max | reference | its p50 | ratio |");
        eprintln!("| --- | ---: | --- | --- | ---: | ---: | ---: | ---: | --- | ---: | ---: |");
    }

    /// Prints the line, and a row of a table for a page of documentation.
    pub fn report(&self) {
        let Self { bench, case, payload_bytes, pinning, pace, seen, reference, raw, counts } = self;
        let [p50, p99, p999, max] = seen.quantiles_us(3);
        let [reference_p50, reference_p99, ..] = raw.quantiles_us(3);
        let ratio = seen.us(0.5) / raw.us(0.5);
        let mut line = json!({
            "bench": bench,
            "case": case,
            "payload_bytes": payload_bytes,
            "pinning": pinning,
            "pace": pace,
            "rounds": seen.rounds(),
            "p50_us": p50,
            "p99_us": p99,
            "p999_us": p999,
            "max_us": max,
            "reference": reference,
            "reference_p50_us": reference_p50,
            "reference_p99_us": reference_p99,
            "ratio_p50": round(ratio, 3),
        });
        if let Value::Object(fields) = &mut line {
            fields.extend(counts.iter().map(|(name, count)| ((*name).to_owned(), json!(round(*count, 3)))));
        }
        println!("{line}");
        let counts: String = counts.iter().map(|(name, count)| format!(" {name} {count:.2}")).collect();
        eprintln!(
            "| {case} | {payload_bytes} | {pinning} | {pace} | {p50:.2} | {p99:.2} | {p999:.2} | {max:.1} | {reference} | {reference_p50:.2} | {ratio:.2} |{counts}"
        );
    }
}
