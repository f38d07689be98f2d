//! Timing figures of a control loop, with an error of at most a tenth of a per cent and bounded memory.

use exoskeleton_model::message::DriveState;
use exoskeleton_recording::plot::Lateness;
use hdrhistogram::Histogram;
use sinew_figures::stalls::LATE_MAX;

use super::PERIOD;
use super::trace::DriveRow;
use crate::report::{LoopSummary, PercentilesUs};

/// Maximum time that is resolved, us.
const LONGEST_US: u64 = 60_000_000;
const BUCKET_US: f64 = 25.0;
const BUCKETS: usize = 120;

/// Timing of one drive's loop, or of several together.
#[derive(Debug, Clone)]
pub struct LoopFigures {
    period: Histogram<u64>,
    lateness: Histogram<u64>,
    sample_age: Histogram<u64>,
    gait_age: Histogram<u64>,
    deadline_misses: u64,
}

impl Default for LoopFigures {
    fn default() -> Self {
        let [period, lateness, sample_age, gait_age] = [(); 4].map(|()| histogram());
        Self { period, lateness, sample_age, gait_age, deadline_misses: 0 }
    }
}

impl LoopFigures {
    /// Counts a tick.
    pub fn note(&mut self, row: &DriveRow) {
        if row.period_us > 0 {
            self.period.saturating_record(u64::from(row.period_us));
        }
        self.lateness.saturating_record(u64::from(row.late_us));
        self.deadline_misses += misses(u64::from(row.late_us));
        if row.state == DriveState::Walk {
            for (histogram, age_us) in
                [(&mut self.sample_age, row.sample_age_us), (&mut self.gait_age, row.gait_age_us)]
            {
                if let Some(age_us) = age_us {
                    histogram.saturating_record(u64::from(age_us));
                }
            }
        }
    }

    /// Returns the figures so far.
    #[must_use]
    pub fn summary(&self) -> LoopSummary {
        LoopSummary {
            ticks: self.lateness.len(),
            period_us: percentiles(&self.period),
            lateness_us: percentiles(&self.lateness),
            sample_age_us: percentiles(&self.sample_age),
            gait_age_us: percentiles(&self.gait_age),
            deadline_misses: self.deadline_misses,
        }
    }

    /// The lateness for the picture; values beyond its right edge are in the last bucket.
    #[must_use]
    pub fn lateness(&self) -> Lateness {
        let mut counts = vec![0; BUCKETS];
        for value in self.lateness.iter_recorded() {
            let bucket = (value.value_iterated_to() as f64 / BUCKET_US) as usize;
            counts[bucket.min(BUCKETS - 1)] += value.count_at_value();
        }
        Lateness { bucket_us: BUCKET_US, counts }
    }
}

/// Returns the percentiles of these times, us.
pub fn percentiles_of(times_us: impl IntoIterator<Item = u32>) -> PercentilesUs {
    let mut histogram = histogram();
    times_us.into_iter().for_each(|time_us| histogram.saturating_record(u64::from(time_us)));
    percentiles(&histogram)
}

fn histogram() -> Histogram<u64> {
    Histogram::new_with_bounds(1, LONGEST_US, 3).expect("1 is at least 1 and 3 digits are few")
}

/// Turns that missed their deadline by a tick that is `late_us` late: itself, and those that it delayed.
fn misses(late_us: u64) -> u64 {
    late_us.saturating_sub(LATE_MAX.as_micros() as u64).div_ceil(PERIOD.as_micros() as u64)
}

fn percentiles(histogram: &Histogram<u64>) -> PercentilesUs {
    let at = |quantile| histogram.value_at_quantile(quantile) as f64;
    PercentilesUs { p50: at(0.5), p99: at(0.99), p999: at(0.999), max: histogram.max() as f64 }
}

#[cfg(test)]
#[path = "../../tests/unit/figures.rs"]
mod tests;
