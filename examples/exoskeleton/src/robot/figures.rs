//! Timing figures of a control loop, with an error of at most a tenth of a per cent and bounded memory.

use hdrhistogram::Histogram;
use serde::Serialize;

use super::PERIOD;
use super::trace::DriveRow;
use crate::message::DriveState;
use crate::plot::Lateness;
use crate::report::PercentilesUs;

/// A tick that is later than this is a missed deadline, us.
pub const LATE_MAX_US: u64 = 2_000;
/// Longest time that is told apart, us.
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

/// The figures as they are told.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct LoopSummary {
    /// Ticks.
    pub ticks: u64,
    /// Time between ticks.
    pub period_us: PercentilesUs,
    /// How late ticks came.
    pub lateness_us: PercentilesUs,
    /// Age of the joint sample that was used while walking: from its sensor's reading to the drive's tick.
    pub sample_age_us: PercentilesUs,
    /// Age of the gait state that was used while walking: from central's tick to the drive's.
    pub gait_age_us: PercentilesUs,
    /// Turns that did not come within 2 ms of their time.
    pub deadline_misses: u64,
}

impl Default for LoopFigures {
    fn default() -> Self {
        Self {
            period: histogram(),
            lateness: histogram(),
            sample_age: histogram(),
            gait_age: histogram(),
            deadline_misses: 0,
        }
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

    /// The figures so far.
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

    /// The lateness for the picture; what is later than its right edge is in the last bucket.
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

/// The percentiles of these times, us.
pub fn percentiles_of(times_us: impl IntoIterator<Item = u32>) -> PercentilesUs {
    let mut histogram = histogram();
    times_us.into_iter().for_each(|time_us| histogram.saturating_record(u64::from(time_us)));
    percentiles(&histogram)
}

fn histogram() -> Histogram<u64> {
    Histogram::new_with_bounds(1, LONGEST_US, 3).expect("1 is at least 1 and 3 digits are few")
}

/// Turns that were lost for their deadline by a tick that is `late_us` late: itself, and those it ran over.
fn misses(late_us: u64) -> u64 {
    late_us.saturating_sub(LATE_MAX_US).div_ceil(PERIOD.as_micros() as u64)
}

fn percentiles(histogram: &Histogram<u64>) -> PercentilesUs {
    let at = |quantile| histogram.value_at_quantile(quantile) as f64;
    PercentilesUs { p50: at(0.5), p99: at(0.99), p999: at(0.999), max: histogram.max() as f64 }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn turns_that_a_late_tick_ran_over_count_as_missed_too() {
        assert_eq!([0, 2_000, 2_001, 3_000, 3_001, 5_200].map(misses), [0, 0, 1, 1, 2, 4]);
    }
}
