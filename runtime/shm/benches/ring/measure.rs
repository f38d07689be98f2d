//! Times of many round trips, and the JSON line that says them.

use std::{
    thread,
    time::{Duration, Instant},
};

use hdrhistogram::Histogram;
use serde_json::json;

/// How round trips follow each other.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Pace {
    BackToBack,
    EveryMillisecond,
}

impl Pace {
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::BackToBack => "back_to_back",
            Self::EveryMillisecond => "1khz",
        }
    }

    /// Round trips that are not counted, and that are.
    const fn rounds(self) -> (u32, u32) {
        match self {
            Self::BackToBack => (1_000, 20_000),
            Self::EveryMillisecond => (50, 1_500),
        }
    }
}

/// The times of one run.
pub(crate) struct Figures(Histogram<u64>);

impl Figures {
    /// Does round trips at this pace.
    pub(crate) fn of(pace: Pace, mut round_trip: impl FnMut()) -> Self {
        let mut times = Histogram::new_with_bounds(1, 10_000_000_000, 3)
            .expect("bounds of 1 ns to 10 s with three digits");
        let (warm_up, rounds) = pace.rounds();
        for round in 0..warm_up + rounds {
            if pace == Pace::EveryMillisecond {
                thread::sleep(Duration::from_millis(1));
            }
            let start = Instant::now();
            round_trip();
            let time = start.elapsed();
            if round >= warm_up {
                times.saturating_record(u64::try_from(time.as_nanos()).unwrap_or(u64::MAX));
            }
        }
        Self(times)
    }

    fn us(&self, quantile: f64) -> f64 {
        self.0.value_at_quantile(quantile) as f64 / 1_000.0
    }
}

/// What a line is about.
pub(crate) struct Run<'a> {
    pub(crate) case: &'a str,
    pub(crate) payload_bytes: usize,
    pub(crate) pinning: &'a str,
    pub(crate) pace: Pace,
    pub(crate) seen: &'a Figures,
    pub(crate) reference: &'a str,
    pub(crate) raw: &'a Figures,
}

/// Prints the line that every bench of Sinew prints.
pub(crate) fn report(run: &Run<'_>) {
    let Run { case, payload_bytes, pinning, pace, seen, reference, raw } = run;
    let line = json!({
        "bench": "ring",
        "case": case,
        "payload_bytes": payload_bytes,
        "pinning": pinning,
        "pace": pace.name(),
        "rounds": seen.0.len(),
        "p50_us": round(seen.us(0.5)),
        "p99_us": round(seen.us(0.99)),
        "p999_us": round(seen.us(0.999)),
        "max_us": round(seen.us(1.0)),
        "reference": reference,
        "reference_p50_us": round(raw.us(0.5)),
        "reference_p99_us": round(raw.us(0.99)),
        "ratio_p50": round(seen.us(0.5) / raw.us(0.5)),
    });
    println!("{line}");
}

fn round(value: f64) -> f64 {
    (value * 1000.0).round() / 1000.0
}

/// The machine, in a line.
pub(crate) fn machine() -> String {
    let cpus = thread::available_parallelism().map_or(0, usize::from);
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = info.lines().find_map(|line| line.strip_prefix("model name")).unwrap_or(": unknown");
    let kernel = std::fs::read_to_string("/proc/sys/kernel/osrelease").unwrap_or_default();
    format!("{cpus} CPUs, {}, Linux {}", model.trim_start_matches([':', ' ', '\t']), kernel.trim())
}
