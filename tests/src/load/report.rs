//! Results of a run with failing layers, as a table and as JSON.

use sinew_testkit::report::Times;
use std::fmt;

use serde_json::{Value, json};
use sinew_testkit::history::{Fault, Verdict};

/// The results of one layer.
#[derive(Clone, Debug)]
pub struct LayerReport {
    /// The name.
    pub name: &'static str,
    /// Time from its panic until it was ready again.
    pub ready: Times,
    /// Messages between the nodes that were lost by its panics.
    pub lost: u64,
}

/// The results.
#[derive(Clone, Debug)]
pub struct Report {
    /// Number of panics of layers.
    pub panics: u64,
    /// Duration of the run.
    pub seconds: f64,
    /// Number of restarted applications.
    pub restarted: u64,
    /// Messages within one node.
    pub in_process: Verdict,
    /// Messages from one node to another.
    pub between_nodes: Verdict,
    /// Messages that found no room or no receiver at first, within the node and between nodes.
    pub again: [u64; 2],
    /// Results of each layer.
    pub layers: Vec<LayerReport>,
    /// Time from a panic until messages sent after it arrived from the other node.
    pub gaps: Times,
}

impl Report {
    /// Machine-readable output in one line.
    #[must_use]
    pub fn json(&self) -> Value {
        let layers = self.layers.iter().map(|layer| {
            let mut json = layer.ready.json();
            (json["layer"], json["lost_between_nodes"]) = (json!(layer.name), json!(layer.lost));
            json
        });
        json!({
            "bench": "layer_panics",
            "panics": self.panics,
            "seconds": self.seconds,
            "applications_restarted": self.restarted,
            "in_process": self.in_process.json(),
            "between_nodes": self.between_nodes.json(),
            "sent_again": self.again,
            "restart_to_ready": layers.collect::<Vec<_>>(),
            "gap_between_nodes": self.gaps.json(),
        })
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        writeln!(
            f,
            "{} layer panics in {:.1} s; applications restarted: {}",
            self.panics, self.seconds, self.restarted
        )?;
        writeln!(
            f,
            "{:<14} {:>9} {:>6} {:>6} {:>6} {:>10} {:>8} {:>6}",
            "messages", "sent", "lost", "twice", "order", "confirmed", "unknown", "wrong"
        )?;
        for (name, verdict) in [("in process", &self.in_process), ("between nodes", &self.between_nodes)] {
            let [lost, twice, order] =
                [Fault::Lost, Fault::Duplicated, Fault::Reordered].map(|fault| verdict.count(fault));
            let wrong = verdict.faults.values().sum::<u64>() - lost - twice - order;
            let unknown = verdict.outcomes.get("unknown").copied().unwrap_or_default();
            let (sent, confirmed, rate) = (verdict.sent, verdict.asked, verdict.sent as f64 / self.seconds);
            writeln!(
                f,
                "{name:<14} {sent:>9} {lost:>6} {twice:>6} {order:>6} {confirmed:>10} {unknown:>8} {wrong:>6}   {rate:.0}/s"
            )?;
        }
        writeln!(
            f,
            "{:<14} {:>6} {:>9} {:>9} {:>9}  lost between nodes",
            "panic to ready", "panics", "p50 ms", "p99 ms", "max ms"
        )?;
        for layer in &self.layers {
            writeln!(f, "{:<14} {}  {}", layer.name, layer.ready, layer.lost)?;
        }
        write!(f, "{:<14} {}", "nodes' gap", self.gaps)
    }
}
