//! Latency histograms and the output format of Sinew's benches: [`Beside`] for a case with a reference in the
//! same run, [`Alone`] for a case without one. JSON lines go to standard output, everything else goes to
//! standard error.
//!
//! The crate also holds the parts that all benches share: command-line arguments ([`Asked`]), child processes
//! ([`process`]), number and pace of round trips ([`Rounds`]), stalls of the host ([`stalls`]),
//! operating-system streams used as references ([`stream`]), files of results ([`results`]), and pictures of
//! measured runs ([`canvas`]).

mod alone;
mod asked;
mod beside;
pub mod canvas;
pub mod documentation;
mod pinning;
pub mod process;
pub mod results;
mod rounds;
pub mod stalls;
pub mod stream;

pub use alone::{Alone, head};
pub use asked::Asked;
pub use beside::Beside;
pub use pinning::{End, Pinning};
pub use rounds::{Pace, Rounds};

use std::time::Duration;

use hdrhistogram::{Histogram, iterators::IterationValue};

/// The times of one run: 1 ns to 60 s, with three significant digits.
#[derive(Debug)]
pub struct Figures(Histogram<u64>);

impl Figures {
    /// An empty histogram.
    ///
    /// # Panics
    /// Never: the bounds of the histogram are valid.
    #[must_use]
    pub fn new() -> Self {
        Self(Histogram::new_with_bounds(1, 60_000_000_000, 3).expect("1 ns to 60 s with three digits"))
    }

    /// Records one time. A time above 60 s counts as 60 s.
    pub fn record(&mut self, time: Duration) {
        self.0.saturating_record(u64::try_from(time.as_nanos()).unwrap_or(u64::MAX).max(1));
    }

    /// Adds all times of another histogram.
    ///
    /// # Panics
    /// Never: all histograms have the same bounds.
    pub fn add(&mut self, other: &Self) {
        self.0.add(&other.0).expect("all have the same bounds");
    }

    /// Prints the histogram for the parent process: one line per bucket, with its count and its value in
    /// nanoseconds.
    pub fn hand_over(&self) {
        let line =
            |step: IterationValue<u64>| format!("{} {}\n", step.count_at_value(), step.value_iterated_to());
        let lines: String = self.0.iter_recorded().map(line).collect();
        print!("{lines}");
    }

    /// Parses the output of [`hand_over`](Self::hand_over); `None` if the lines are malformed.
    #[must_use]
    pub fn taken(printed: &str) -> Option<Self> {
        let mut figures = Self::new();
        for line in printed.lines() {
            let (count, nanos) = line.split_once(' ')?;
            figures.0.saturating_record_n(nanos.parse().ok()?, count.parse().ok()?);
        }
        (figures.rounds() > 0).then_some(figures)
    }

    /// Number of recorded times.
    #[must_use]
    pub fn rounds(&self) -> u64 {
        self.0.len()
    }

    /// The 99th percentile.
    #[must_use]
    pub fn p99(&self) -> Duration {
        Duration::from_nanos(self.0.value_at_quantile(0.99))
    }

    /// The time at this quantile, in microseconds.
    fn us(&self, quantile: f64) -> f64 {
        self.0.value_at_quantile(quantile) as f64 / 1_000.0
    }

    /// p50, p99, p99.9 and the maximum, in microseconds, with this many decimal places.
    fn quantiles_us(&self, digits: i32) -> [f64; 4] {
        [0.5, 0.99, 0.999, 1.0].map(|quantile| round(self.us(quantile), digits))
    }
}

impl Default for Figures {
    fn default() -> Self {
        Self::new()
    }
}

fn round(value: f64, digits: i32) -> f64 {
    let unit = 10_f64.powi(digits);
    (value * unit).round() / unit
}

/// The CPUs and the kernel of this machine, in one line.
#[must_use]
pub fn hardware() -> String {
    let cpus = std::thread::available_parallelism().map_or(0, usize::from);
    let info = std::fs::read_to_string("/proc/cpuinfo").unwrap_or_default();
    let model = info.lines().find_map(|line| line.strip_prefix("model name")).unwrap_or(": unknown");
    let model = model.trim_start_matches([':', ' ', '\t']);
    let kernel = std::fs::read_to_string("/proc/sys/kernel/osrelease").unwrap_or_default();
    format!("{cpus} CPUs, {model}, Linux {}", kernel.trim())
}

/// The machine and its current load, in one line.
#[must_use]
pub fn machine() -> String {
    let load = std::fs::read_to_string("/proc/loadavg").unwrap_or_default();
    let load = load.split(' ').next().unwrap_or("unknown");
    format!("{}, load {load}", hardware())
}
