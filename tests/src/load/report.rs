//! What was seen of layers that fail under load, as a table and as JSON.

use std::{fmt, time::Duration};

use serde_json::{Value, json};

/// Times, of which the percentiles are asked.
#[derive(Clone, Debug, Default)]
pub struct Times(Vec<Duration>);

impl Times {
    /// One more.
    pub fn note(&mut self, time: Duration) {
        self.0.push(time);
    }

    /// All of these, too.
    pub fn add(&mut self, others: Self) {
        self.0.extend(others.0);
    }

    /// How many there are.
    #[must_use]
    pub fn count(&self) -> usize {
        self.0.len()
    }

    /// The time that this share of them does not exceed; zero if there are none.
    #[must_use]
    pub fn percentile(&self, share: f64) -> Duration {
        let mut sorted = self.0.clone();
        sorted.sort();
        let rank = (share * sorted.len() as f64).ceil() as usize;
        sorted.get(rank.saturating_sub(1).min(sorted.len().saturating_sub(1))).copied().unwrap_or_default()
    }

    /// Count, median, 99th percentile and largest in milliseconds.
    #[must_use]
    pub fn json(&self) -> Value {
        let ms = |share| self.percentile(share).as_secs_f64() * 1e3;
        json!({ "count": self.count(), "p50_ms": ms(0.5), "p99_ms": ms(0.99), "max_ms": ms(1.0) })
    }
}

impl fmt::Display for Times {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let ms = |share| self.percentile(share).as_secs_f64() * 1e3;
        write!(f, "{:>6} {:>9.3} {:>9.3} {:>9.3}", self.count(), ms(0.5), ms(0.99), ms(1.0))
    }
}

/// What became of the messages of one way.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct Account {
    /// Taken by the runtime.
    pub sent: u64,
    /// Handled, each counted once.
    pub handled: u64,
    /// Never handled.
    pub lost: u64,
    /// Handled once more.
    pub duplicated: u64,
    /// Handled after a later one of their class.
    pub reordered: u64,
    /// Of those sent, confirmed ones.
    pub confirmed: u64,
    /// Of the confirmed, delivered.
    pub delivered: u64,
    /// Of the confirmed, ended as `Unknown` and were handled.
    pub unknown_handled: u64,
    /// Of the confirmed, ended as `Unknown` and were not.
    pub unknown_lost: u64,
    /// Of the confirmed, said to be delivered and never seen, or ended as nothing may end here.
    pub wrong: u64,
    /// Not taken at once, and sent again.
    pub again: u64,
}

impl Account {
    /// Whether every message was handled once and in order, and every confirmed one was said to be.
    #[must_use]
    pub const fn is_perfect(&self) -> bool {
        self.lost == 0 && self.unknown_handled == 0 && self.is_true()
    }

    /// Whether nothing came twice or out of order, and no outcome was wrong. Some may be lost, and say `Unknown` if
    /// they were confirmed.
    #[must_use]
    pub const fn is_true(&self) -> bool {
        self.duplicated == 0
            && self.reordered == 0
            && self.wrong == 0
            && self.sent == self.handled + self.lost
            && self.confirmed == self.delivered + self.unknown_handled + self.unknown_lost
    }

    fn json(&self) -> Value {
        json!({
            "sent": self.sent, "handled": self.handled, "lost": self.lost, "duplicated": self.duplicated,
            "reordered": self.reordered, "confirmed": self.confirmed, "delivered": self.delivered,
            "unknown_handled": self.unknown_handled, "unknown_lost": self.unknown_lost, "wrong": self.wrong,
            "sent_again": self.again,
        })
    }
}

impl fmt::Display for Account {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        write!(
            f,
            "{:>9} {:>6} {:>6} {:>6} {:>10} {:>8} {:>6}",
            self.sent,
            self.lost,
            self.duplicated,
            self.reordered,
            self.confirmed,
            self.unknown_handled + self.unknown_lost,
            self.wrong
        )
    }
}

/// How one layer did.
#[derive(Clone, Debug)]
pub struct LayerReport {
    /// Its name.
    pub name: &'static str,
    /// From its panic until it was ready again.
    pub ready: Times,
    /// Messages between the nodes that its deaths lost.
    pub lost: u64,
}

/// What was seen.
#[derive(Clone, Debug)]
pub struct Report {
    /// Layers that were killed.
    pub panics: u64,
    /// How long it took.
    pub seconds: f64,
    /// Applications that were restarted.
    pub restarted: u64,
    /// Within one node.
    pub in_process: Account,
    /// From one node to another.
    pub between_nodes: Account,
    /// Each layer.
    pub layers: Vec<LayerReport>,
    /// From a panic until messages sent after it arrived from the other node.
    pub gaps: Times,
}

impl Report {
    /// One line for other programs.
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
        for (name, account, seconds) in [
            ("in process", self.in_process, self.seconds),
            ("between nodes", self.between_nodes, self.seconds),
        ] {
            writeln!(f, "{name:<14} {account}   {:.0}/s", account.sent as f64 / seconds)?;
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
