//! A histogram of wake-up lateness of bounded size, and its percentiles.

use std::time::Duration;

use hdrhistogram::Histogram;

/// Longest distinguished lateness in nanoseconds; a longer one is recorded as this one.
const LATENESS_MAX_NS: u64 = 60_000_000_000;
/// Significant decimal digits of the histogram: a percentile is at most 1 % too long.
const DIGITS: u8 = 2;
/// Upper bounds of the bands in microseconds; the last one is [`LATENESS_MAX_NS`].
const BANDS_US: [u64; 25] = [
    1, 2, 5, 10, 20, 50, 100, 200, 500, 1_000, 2_000, 5_000, 10_000, 20_000, 50_000, 100_000, 200_000,
    500_000, 1_000_000, 2_000_000, 5_000_000, 10_000_000, 20_000_000, 50_000_000, 60_000_000,
];

/// The lateness of many wake-ups: a histogram with some 30 KiB for any number of wake-ups.
///
/// # Examples
///
/// ```
/// use std::time::Duration;
/// use sinew::real_time::Lateness;
///
/// let mut lateness = Lateness::new();
/// for us in 1..=1_000 {
///     lateness.record(Duration::from_micros(us));
/// }
/// let summary = lateness.summary();
/// assert_eq!((summary.turns, summary.max), (1_000, Duration::from_millis(1)));
/// // At most 1 % above the exact percentile.
/// assert!((500..=505).contains(&summary.p50.as_micros()));
/// ```
#[derive(Clone, Debug)]
pub struct Lateness {
    histogram: Histogram<u64>,
    max: Duration,
}

/// The percentiles of a [`Lateness`]; all are zero without a wake-up.
///
/// # Examples
///
/// ```
/// use sinew::real_time::{Lateness, LatenessSummary};
///
/// assert_eq!(Lateness::new().summary(), LatenessSummary::default());
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct LatenessSummary {
    /// Number of wake-ups.
    pub turns: u64,
    /// The median.
    pub p50: Duration,
    /// The 99th percentile.
    pub p99: Duration,
    /// The 99.9th percentile.
    pub p999: Duration,
    /// The longest lateness, exact.
    pub max: Duration,
}

/// A part of a histogram: the wake-ups that are later than the bound of the part before, up to its own bound.
///
/// # Examples
///
/// ```
/// use std::time::Duration;
/// use sinew::real_time::{Band, Lateness};
///
/// let mut lateness = Lateness::new();
/// lateness.record(Duration::from_micros(30));
/// assert_eq!(lateness.bands(), [Band { up_to: Duration::from_micros(50), turns: 1 }]);
/// ```
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Band {
    /// Upper bound of the lateness.
    pub up_to: Duration,
    /// Number of wake-ups.
    pub turns: u64,
}

impl Lateness {
    /// Returns an empty histogram. It never allocates again.
    ///
    /// # Panics
    /// Never: the bounds of the histogram are valid.
    #[must_use]
    pub fn new() -> Self {
        let histogram =
            Histogram::new_with_bounds(1, LATENESS_MAX_NS, DIGITS).expect("1 ns to 60 s with two digits");
        Self { histogram, max: Duration::ZERO }
    }

    /// Records one wake-up. Does not allocate.
    pub fn record(&mut self, lateness: Duration) {
        let nanos = u64::try_from(lateness.as_nanos()).unwrap_or(u64::MAX);
        self.histogram.saturating_record(nanos.max(1));
        self.max = self.max.max(lateness);
    }

    /// Returns the percentiles.
    #[must_use]
    pub fn summary(&self) -> LatenessSummary {
        let at = |quantile| Duration::from_nanos(self.histogram.value_at_quantile(quantile)).min(self.max);
        let turns = self.histogram.len();
        if turns == 0 {
            return LatenessSummary::default();
        }
        LatenessSummary { turns, p50: at(0.5), p99: at(0.99), p999: at(0.999), max: self.max }
    }

    /// Returns the histogram in bands with bounds in the steps 1, 2, 5, 10, from the first band with a wake-up to
    /// the last one. A wake-up within 1 % of a bound may be counted in the next band.
    #[must_use]
    pub fn bands(&self) -> Vec<Band> {
        let band = |us: &u64| Band { up_to: Duration::from_micros(*us), turns: 0 };
        let mut bands: Vec<_> = BANDS_US.iter().map(band).collect();
        for step in self.histogram.iter_recorded() {
            let lateness = Duration::from_nanos(step.value_iterated_to()).min(self.max);
            let at = bands.partition_point(|band| band.up_to < lateness).min(bands.len() - 1);
            bands[at].turns += step.count_at_value();
        }
        let first = bands.iter().position(|band| band.turns > 0).unwrap_or(bands.len());
        let last = bands.iter().rposition(|band| band.turns > 0).map_or(first, |last| last + 1);
        bands[first..last].to_vec()
    }
}

impl Default for Lateness {
    fn default() -> Self {
        Self::new()
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn of(nanos: &[u64]) -> Lateness {
        let mut lateness = Lateness::new();
        nanos.iter().for_each(|nanos| lateness.record(Duration::from_nanos(*nanos)));
        lateness
    }

    /// The exact percentile: the smallest recorded value that is not below this part of all values.
    fn exact(sorted: &[u64], quantile: f64) -> u64 {
        let rank = (quantile * sorted.len() as f64).ceil() as usize;
        sorted[rank.clamp(1, sorted.len()) - 1]
    }

    proptest! {
        #[test]
        fn percentiles_are_at_most_one_percent_too_long(
            mut nanos in proptest::collection::vec(prop_oneof![1_u64..100_000, 1_u64..LATENESS_MAX_NS], 1..2_000)
        ) {
            let summary = of(&nanos).summary();
            nanos.sort_unstable();
            for (found, quantile) in [(summary.p50, 0.5), (summary.p99, 0.99), (summary.p999, 0.999)] {
                let (found, exact) = (found.as_nanos(), u128::from(exact(&nanos, quantile)));
                prop_assert!(exact <= found && found <= exact + exact / 100 + 1, "{quantile}: {found}, {exact}");
            }
            let max = nanos.last().copied().map(Duration::from_nanos);
            prop_assert_eq!((summary.turns, Some(summary.max)), (nanos.len() as u64, max));
        }

        #[test]
        fn every_wake_up_is_in_one_band(nanos in proptest::collection::vec(1_u64..2 * LATENESS_MAX_NS, 1..500)) {
            let bands = of(&nanos).bands();
            prop_assert_eq!(bands.iter().map(|band| band.turns).sum::<u64>(), nanos.len() as u64);
            prop_assert!(bands[0].turns > 0 && bands[bands.len() - 1].turns > 0);
            prop_assert!(bands.is_sorted_by(|before, after| before.up_to < after.up_to));
        }
    }

    #[test]
    fn each_lateness_is_counted_in_its_band() {
        let us = Duration::from_micros;
        let bands = of(&[1_500, 15_000, 30_000, 90_000]).bands();
        let expected = [(2, 1), (5, 0), (10, 0), (20, 1), (50, 1), (100, 1)];
        let found: Vec<_> = bands.iter().map(|band| (band.up_to, band.turns)).collect();
        assert_eq!(found, expected.map(|(bound, turns)| (us(bound), turns)));
    }

    #[test]
    fn lateness_beyond_histogram_is_counted_with_exact_maximum() {
        let lateness = of(&[1, 3 * LATENESS_MAX_NS]);
        assert_eq!(lateness.summary().max, Duration::from_secs(180));
        assert_eq!(lateness.bands().last().map(|band| band.turns), Some(1));
    }
}
