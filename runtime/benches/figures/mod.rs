//! Times of a run, as a JSON line and as a line of a table.

use std::time::Duration;

use hdrhistogram::Histogram;
use serde_json::{Map, Value, json};

/// The times of one run, in nanoseconds.
pub(crate) struct Figures(Histogram<u64>);

impl Figures {
    pub(crate) fn new() -> Self {
        Self(Histogram::new_with_bounds(1, 60_000_000_000, 3).expect("1 ns to 60 s with three digits"))
    }

    pub(crate) fn record(&mut self, time: Duration) {
        self.0.saturating_record(u64::try_from(time.as_nanos()).unwrap_or(u64::MAX).max(1));
    }

    fn us(&self, quantile: f64) -> f64 {
        (self.0.value_at_quantile(quantile) as f64 / 100.0).round() / 10.0
    }
}

/// What one line is about.
pub(crate) struct Line<'a> {
    pub(crate) bench: &'a str,
    pub(crate) case: &'a str,
    /// What was timed.
    pub(crate) figure: &'a str,
    pub(crate) seen: &'a Figures,
    /// Counts beside the times.
    pub(crate) counts: &'a [(&'a str, u64)],
}

/// The head of the table, on the standard error: the JSON lines alone are on the standard output.
pub(crate) fn head() {
    eprintln!("machine: {}", machine());
    eprintln!(
        "{:<34} {:<34} {:>8} {:>10} {:>10} {:>10} {:>10}",
        "case", "figure", "n", "p50 us", "p99 us", "p99.9 us", "max us"
    );
}

pub(crate) fn report(line: &Line<'_>) {
    let Line { bench, case, figure, seen, counts } = line;
    let [p50, p99, p999, max] = [0.5, 0.99, 0.999, 1.0].map(|quantile| seen.us(quantile));
    let n = seen.0.len();
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

/// The machine, in a line.
fn machine() -> String {
    let cpus = std::thread::available_parallelism().map_or(0, usize::from);
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = info.lines().find_map(|line| line.strip_prefix("model name")).unwrap_or(": unknown");
    let kernel = std::fs::read_to_string("/proc/sys/kernel/osrelease").unwrap_or_default();
    let load = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    let load = load.split(' ').next().unwrap_or("unknown");
    format!(
        "{cpus} CPUs, {}, Linux {}, load {load}",
        model.trim_start_matches([':', ' ', '\t']),
        kernel.trim()
    )
}
