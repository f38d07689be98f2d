//! Results of a case beside its reference, as a JSON line.

use serde_json::{Value, json};

use crate::{Figures, round};

/// Round-trip times of one case, and of the reference that ran immediately before it.
#[derive(Debug)]
pub struct Beside<'a> {
    /// Name of the bench.
    pub bench: &'a str,
    /// Name of the case.
    pub case: &'a str,
    /// Payload of a message, in bytes.
    pub payload_bytes: usize,
    /// Pinning of the two ends to CPUs.
    pub pinning: &'a str,
    /// Pace of the round trips.
    pub pace: &'a str,
    /// Times of the case.
    pub seen: &'a Figures,
    /// Name of the reference.
    pub reference: &'a str,
    /// Times of the reference.
    pub raw: &'a Figures,
    /// Named counters printed beside the times.
    pub counts: &'a [(&'a str, f64)],
}

impl Beside<'_> {
    /// Prints the header of the table with the rows that [`report`](Self::report) prints.
    pub fn head() {
        eprintln!("| case | payload | CPUs | pace | p50 | p99 | p99.9 | max | reference | its p50 | ratio |");
        eprintln!("| --- | ---: | --- | --- | ---: | ---: | ---: | ---: | --- | ---: | ---: |");
    }

    /// Prints the JSON line, and a table row for a page of documentation.
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
