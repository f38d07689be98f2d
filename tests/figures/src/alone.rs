//! Results of a case without a reference, as a JSON line and as a table row.

use serde_json::{Map, Value, json};

use crate::{Figures, machine};

/// The timings of one case.
#[derive(Debug)]
pub struct Alone<'a> {
    /// Name of the bench.
    pub bench: &'a str,
    /// Name of the case.
    pub case: &'a str,
    /// Name of the timed quantity.
    pub figure: &'a str,
    /// The recorded times.
    pub seen: &'a Figures,
    /// Named counters printed beside the times.
    pub counts: &'a [(&'a str, u64)],
}

/// Prints the machine description and the table header.
pub fn head() {
    eprintln!("machine: {}", machine());
    eprintln!(
        "{:<34} {:<34} {:>8} {:>10} {:>10} {:>10} {:>10}",
        "case", "figure", "n", "p50 us", "p99 us", "p99.9 us", "max us"
    );
}

impl Alone<'_> {
    /// Prints the JSON line and the table row.
    pub fn report(&self) {
        let Self { bench, case, figure, seen, counts } = self;
        let (n, [p50, p99, p999, max]) = (seen.rounds(), seen.quantiles_us(1));
        let mut object: Map<String, Value> =
            counts.iter().map(|(name, n)| ((*name).to_owned(), json!(n))).collect();
        let fields = json!({
            "bench": bench, "case": case, "figure": figure, "rounds": n,
            "p50_us": p50, "p99_us": p99, "p999_us": p999, "max_us": max,
        });
        if let Value::Object(fields) = fields {
            object.extend(fields);
        }
        println!("{}", Value::Object(object));
        let counts: String = counts.iter().map(|(name, n)| format!("  {name} {n}")).collect();
        eprintln!("{case:<34} {figure:<34} {n:>8} {p50:>10.1} {p99:>10.1} {p999:>10.1} {max:>10.1}{counts}");
    }
}
