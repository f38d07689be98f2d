//! The samples of one answer, and their encoding.

use std::{collections::BTreeMap, fmt};

use prometheus_client::{
    collector::Collector,
    encoding::{DescriptorEncoder, NoLabelSet},
    metrics::MetricType,
    registry::Unit,
};

use super::table::{METRICS, Metric, SAMPLES_LEFT_OUT, Shape};

/// Maximum number of samples of one answer: some 10 MB. Further ones are counted.
const SAMPLES_MAX: usize = 100_000;

type Labels = Vec<(&'static str, String)>;

#[derive(Clone, Copy, Debug, PartialEq)]
enum Value {
    Count(u64),
    Level(f64),
}

/// The samples of one answer. A set of labels has one sample of each metric.
#[derive(Debug, Default)]
pub(super) struct Samples {
    families: BTreeMap<&'static str, BTreeMap<Labels, Value>>,
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
        debug_assert_eq!(metric.labels.len(), N, "the labels of {}", metric.name);
        let labels: Labels =
            metric.labels.iter().copied().zip(labels).map(|(key, text)| (key, text.to_owned())).collect();
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

    /// Adds the number of left-out samples, which has room in any case.
    pub(super) fn finish(mut self) -> Self {
        let left_out = Value::Level(self.left_out as f64);
        self.families.entry(SAMPLES_LEFT_OUT.name).or_default().insert(Vec::new(), left_out);
        self
    }
}

const fn kind(shape: Shape) -> MetricType {
    match shape {
        Shape::Counter => MetricType::Counter,
        Shape::Gauge => MetricType::Gauge,
    }
}

impl Collector for Samples {
    fn encode(&self, mut encoder: DescriptorEncoder<'_>) -> fmt::Result {
        for metric in METRICS {
            let Some(family) = self.families.get(metric.name) else { continue };
            let unit = metric.is_seconds.then_some(Unit::Seconds);
            let mut descriptor =
                encoder.encode_descriptor(metric.name, metric.help, unit.as_ref(), kind(metric.shape))?;
            for (labels, value) in family {
                let mut sample = descriptor.encode_family(labels)?;
                match value {
                    Value::Count(count) => sample.encode_counter::<NoLabelSet, _, f64>(count, None)?,
                    Value::Level(level) => sample.encode_gauge(level)?,
                }
            }
        }
        Ok(())
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::metrics::table::{NODE_UP, REFUSED};

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
}
