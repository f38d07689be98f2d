//! The samples of one answer, and their encoding.

use std::{collections::BTreeMap, fmt};

use prometheus_client::{
    collector::Collector,
    encoding::{DescriptorEncoder, NoLabelSet},
    metrics::MetricType,
    registry::Unit,
};
use sinew::inspect::{AGE_BOUNDS_US, AGE_BUCKETS, AgesReport};

use super::{
    system::micros,
    table::{METRICS, Metric, SAMPLES_LEFT_OUT, Shape},
};

/// Maximum number of samples of one answer: some 10 MB. Further ones are counted.
const SAMPLES_MAX: usize = 100_000;

type Labels = Vec<(&'static str, String)>;

#[derive(Clone, Copy, Debug, PartialEq)]
enum Value {
    Count(u64),
    Level(f64),
}

/// The samples of a histogram.
#[derive(Clone, Copy, Debug, PartialEq)]
struct Times {
    counts: [u64; AGE_BUCKETS],
    /// In seconds.
    sum: f64,
}

impl Times {
    /// Number of lines of a histogram: its buckets, their sum and their number.
    const LINES: usize = AGE_BUCKETS + 2;

    /// Returns the upper bound of each bucket in seconds, and the number of times in it. The encoder adds these
    /// numbers up. Another node may report any, so each is limited.
    fn buckets(&self) -> Vec<(f64, u64)> {
        let bounds = AGE_BOUNDS_US.iter().map(|bound| micros(*bound)).chain([f64::INFINITY]);
        let counts = self.counts.iter().map(|count| (*count).min(u64::MAX / AGE_BUCKETS as u64));
        bounds.zip(counts).collect()
    }
}

/// The samples of one answer. A set of labels has one sample of each metric.
#[derive(Debug, Default)]
pub(super) struct Samples {
    families: BTreeMap<&'static str, BTreeMap<Labels, Value>>,
    histograms: BTreeMap<&'static str, BTreeMap<Labels, Times>>,
    count: usize,
    left_out: u64,
}

impl Samples {
    /// Adds to a counter. Values for the same labels are added up.
    pub(super) fn count<const N: usize>(&mut self, metric: &Metric, labels: [&str; N], count: u64) {
        debug_assert_eq!(metric.shape, Shape::Counter, "{}", metric.name);
        self.merge(metric, labels, Value::Count(count));
    }

    /// Sets a gauge. Of several values for the same labels the greatest is kept.
    pub(super) fn level<const N: usize>(&mut self, metric: &Metric, labels: [&str; N], level: f64) {
        debug_assert_eq!(metric.shape, Shape::Gauge, "{}", metric.name);
        self.merge(metric, labels, Value::Level(level));
    }

    fn merge<const N: usize>(&mut self, metric: &Metric, labels: [&str; N], value: Value) {
        let labels = named(metric, labels);
        let family = self.families.entry(metric.name).or_default();
        if let Some(known) = family.get_mut(&labels) {
            *known = match (*known, value) {
                // Another node may report any number.
                (Value::Count(one), Value::Count(other)) => Value::Count(one.saturating_add(other)),
                (Value::Level(one), Value::Level(other)) => Value::Level(one.max(other)),
                (Value::Count(_), Value::Level(_)) | (Value::Level(_), Value::Count(_)) => value,
            };
        } else if self.count < SAMPLES_MAX {
            family.insert(labels, value);
            self.count += 1;
        } else {
            self.left_out += 1;
        }
    }

    /// Adds to a histogram. Values for the same labels are added up. Buckets of another version are ignored.
    pub(super) fn ages<const N: usize>(&mut self, metric: &Metric, labels: [&str; N], report: &AgesReport) {
        debug_assert_eq!(metric.shape, Shape::Histogram, "{}", metric.name);
        let Ok(counts) = <[u64; AGE_BUCKETS]>::try_from(report.counts.as_slice()) else { return };
        let sum = micros(report.sum_us);
        let labels = named(metric, labels);
        let family = self.histograms.entry(metric.name).or_default();
        if let Some(known) = family.get_mut(&labels) {
            known.sum += sum;
            for (known, count) in known.counts.iter_mut().zip(counts) {
                *known = known.saturating_add(count);
            }
        } else if self.count + Times::LINES <= SAMPLES_MAX {
            family.insert(labels, Times { counts, sum });
            self.count += Times::LINES;
        } else {
            self.left_out += Times::LINES as u64;
        }
    }

    /// Adds the number of left-out samples, which has room in any case.
    pub(super) fn finish(mut self) -> Self {
        let left_out = Value::Level(self.left_out as f64);
        self.families.entry(SAMPLES_LEFT_OUT.name).or_default().insert(Vec::new(), left_out);
        self
    }
}

/// Returns the labels with their names.
fn named<const N: usize>(metric: &Metric, labels: [&str; N]) -> Labels {
    debug_assert_eq!(metric.labels.len(), N, "the labels of {}", metric.name);
    metric.labels.iter().copied().zip(labels).map(|(key, text)| (key, text.to_owned())).collect()
}

const fn kind(shape: Shape) -> MetricType {
    match shape {
        Shape::Counter => MetricType::Counter,
        Shape::Gauge => MetricType::Gauge,
        Shape::Histogram => MetricType::Histogram,
    }
}

impl Collector for Samples {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> fmt::Result {
        for metric in METRICS {
            let (family, times) = (self.families.get(metric.name), self.histograms.get(metric.name));
            if family.is_none() && times.is_none() {
                continue;
            }
            let unit = metric.is_seconds.then_some(Unit::Seconds);
            let mut descriptor =
                encoder.encode_descriptor(metric.name, metric.help, unit.as_ref(), kind(metric.shape))?;
            for (labels, value) in family.into_iter().flatten() {
                let mut sample = descriptor.encode_family(labels)?;
                match value {
                    Value::Count(count) => sample.encode_counter::<NoLabelSet, _, f64>(count, None)?,
                    Value::Level(level) => sample.encode_gauge(level)?,
                }
            }
            for (labels, times) in times.into_iter().flatten() {
                let buckets = times.buckets();
                let count: u64 = buckets.iter().map(|(_, count)| count).sum();
                let mut sample = descriptor.encode_family(labels)?;
                sample.encode_histogram::<NoLabelSet>(times.sum, count, &buckets, None)?;
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::metrics::table::{APP_AGE, NODE_UP, REFUSED};

    #[test]
    fn counters_add_up_and_gauges_keep_the_greatest() {
        let mut samples = Samples::default();
        for count in [2, 3, u64::MAX] {
            samples.count(&REFUSED, ["hip", "malformed"], count);
        }
        for level in [0.0, 1.0, 0.0] {
            samples.level(&NODE_UP, ["hip"], level);
        }
        assert_eq!(samples.count, 2);
        let only = |name: &str| samples.families[name].values().copied().collect::<Vec<_>>();
        assert_eq!(only(REFUSED.name), [Value::Count(u64::MAX)]);
        assert_eq!(only(NODE_UP.name), [Value::Level(1.0)]);
    }

    #[test]
    fn samples_have_a_bound_and_further_ones_are_counted() {
        let mut samples = Samples::default();
        for number in 0..SAMPLES_MAX + 7 {
            samples.level(&NODE_UP, [&number.to_string()], 1.0);
        }
        let samples = samples.finish();
        assert_eq!((samples.count, samples.families[NODE_UP.name].len()), (SAMPLES_MAX, SAMPLES_MAX));
        assert_eq!(samples.families[SAMPLES_LEFT_OUT.name][&Vec::new()], Value::Level(7.0));
    }

    #[test]
    fn buckets_of_any_node_are_added_up_within_bounds() {
        let mut samples = Samples::default();
        let report = |counts: Vec<u64>| AgesReport { counts, sum_us: 2_000_000 };
        for count in [1, 2, u64::MAX] {
            samples.ages(&APP_AGE, ["hip", "drive"], &report(vec![count; AGE_BUCKETS]));
        }
        // Another version has other bounds.
        samples.ages(&APP_AGE, ["hip", "gait"], &report(vec![1]));
        assert_eq!(samples.count, Times::LINES);
        let times: Vec<_> = samples.histograms[APP_AGE.name].values().copied().collect();
        assert_eq!(times, [Times { counts: [u64::MAX; AGE_BUCKETS], sum: 6.0 }]);
        let buckets = times[0].buckets();
        assert!(buckets.iter().try_fold(0_u64, |sum, (_, count)| sum.checked_add(*count)).is_some());
    }
}
