//! The table of all metrics, and their samples from a snapshot.

mod apps;
mod messages;
mod peers;
mod samples;
mod system;
mod table;
#[cfg(test)]
pub(crate) mod tests;

use std::fmt;

use prometheus_client::{
    encoding::{prometheus_text, text},
    registry::Registry,
};
use sinew::Time;

use self::samples::Samples;
pub use self::table::{METRICS, Metric, Shape};
use crate::{
    foxglove::Counts,
    nodes::{NodeLabels, NodeRow},
    snapshot::Snapshot,
};

/// The format of the answer.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Format {
    /// OpenMetrics 1.0.
    OpenMetrics,
    /// The older text format of Prometheus.
    PlainText,
}

impl Format {
    pub(crate) const fn content_type(self) -> &'static str {
        match self {
            Self::OpenMetrics => "application/openmetrics-text; version=1.0.0; charset=utf-8",
            Self::PlainText => prometheus_text::CONTENT_TYPE,
        }
    }
}

/// Returns all metrics of a snapshot as text, and those of the server for Foxglove, if there is one.
pub(crate) fn encode(
    snapshot: &Snapshot,
    foxglove: Option<Counts>,
    now: Time,
    format: Format,
) -> Result<String, fmt::Error> {
    let mut registry = Registry::with_prefix(table::PREFIX);
    registry.register_collector(Box::new(samples(snapshot, foxglove, now)));
    let mut encoded = String::new();
    match format {
        Format::OpenMetrics => text::encode(&mut encoded, &registry)?,
        Format::PlainText => prometheus_text::encode(&mut encoded, &registry)?,
    }
    Ok(encoded)
}

fn samples(snapshot: &Snapshot, foxglove: Option<Counts>, now: Time) -> Samples {
    let labels = NodeLabels::of(snapshot);
    let rows: Vec<NodeRow> = crate::nodes::rows(snapshot, &labels);
    let mut samples = Samples::default();
    system::add(&mut samples, snapshot, &rows, now);
    if let Some(counts) = foxglove {
        system::add_foxglove(&mut samples, counts);
    }
    let mut all_names = Vec::new();
    for answers in snapshot.answers() {
        let node = labels.get(answers.node.node);
        system::add_node(&mut samples, answers, &node);
        peers::add(&mut samples, &answers.node, &node, &labels);
        let mut names = apps::add(&mut samples, answers, &node, &snapshot.own);
        messages::add(&mut samples, &answers.audit, &node, (&mut names, &labels));
        all_names.push(names);
    }
    // They have the most samples: beyond the bound they are left out first.
    for (answers, names) in snapshot.answers().zip(&mut all_names) {
        apps::add_ages(&mut samples, &answers.tree, &labels.get(answers.node.node), names);
    }
    samples.finish()
}
