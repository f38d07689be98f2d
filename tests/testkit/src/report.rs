//! Durations with percentiles.

use std::{fmt, time::Duration};

use serde_json::{Value, json};

/// Durations, with percentiles.
#[derive(Clone, Debug, Default)]
pub struct Times(Vec<Duration>);

impl Times {
    /// Adds a duration.
    pub fn note(&mut self, time: Duration) {
        self.0.push(time);
    }

    /// Adds all durations of another set.
    pub fn add(&mut self, others: Self) {
        self.0.extend(others.0);
    }

    /// The number of durations.
    #[must_use]
    pub fn count(&self) -> usize {
        self.0.len()
    }

    /// The percentile at this share; zero if there are no durations.
    #[must_use]
    pub fn percentile(&self, share: f64) -> Duration {
        let mut sorted = self.0.clone();
        sorted.sort();
        let rank = (share * sorted.len() as f64).ceil() as usize;
        sorted.get(rank.saturating_sub(1).min(sorted.len().saturating_sub(1))).copied().unwrap_or_default()
    }

    /// Count, median, 99th percentile and maximum in milliseconds.
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
