//! Results of a run with a slow consumer.

use std::{fmt, time::Duration};

use serde_json::{Value, json};

use super::Plan;

/// Maximum ratio of the p99 of other requests. A higher ratio counts as a slowdown.
const RATIO_MAX: f64 = 1.5;

/// One observation of the two nodes.
#[derive(Clone, Copy, Debug)]
pub struct Window {
    /// Answered requests.
    pub count: u64,
    /// Requests without an answer.
    pub failed: u64,
    /// Median latency.
    pub p50: Duration,
    /// 99th percentile.
    pub p99: Duration,
    /// Maximum.
    pub max: Duration,
    /// Memory of sender and receiver at the start, in bytes.
    pub before: [u64; 2],
    /// Peak memory.
    pub most: [u64; 2],
}

impl Window {
    /// Combines it with the following observation; of the latencies the longer ones count.
    pub(super) fn and(self, next: Self) -> Self {
        Self {
            count: self.count + next.count,
            failed: self.failed + next.failed,
            p50: self.p50.max(next.p50),
            p99: self.p99.max(next.p99),
            max: self.max.max(next.max),
            before: self.before,
            most: [0, 1].map(|node: usize| self.most[node].max(next.most[node])),
        }
    }
}

/// The results.
#[derive(Clone, Debug)]
pub struct Report {
    pub(super) plan: Plan,
    /// Without Bulk.
    pub quiet: Window,
    /// With a fast consumer.
    pub fast: Window,
    /// With a slow consumer.
    pub slow: Window,
    /// Messages handled by the slow consumer.
    pub taken: u64,
    /// Messages offered in total.
    pub offered: u64,
    /// Offered messages that were rejected at once, for lack of room.
    pub refused: u64,
    /// Maximum memory growth of sender and receiver, in bytes.
    pub bounds: [u64; 2],
}

impl Report {
    /// Memory growth of sender and receiver while the consumer was slow, in bytes.
    #[must_use]
    pub fn growth(&self) -> [u64; 2] {
        [0, 1].map(|node: usize| self.slow.most[node].saturating_sub(self.quiet.before[node]))
    }

    /// Returns whether both nodes stayed within their bounds, and every request was answered.
    #[must_use]
    pub fn is_bounded(&self) -> bool {
        let [here, there] = self.growth();
        here <= self.bounds[0] && there <= self.bounds[1] && self.slow.failed == 0
    }

    /// Ratio of the others' latency to that beside a fast consumer.
    #[must_use]
    pub fn ratio(&self) -> f64 {
        self.ratio_to(&self.fast)
    }

    /// Ratio to the latency without Bulk: it includes the cost of the messages themselves.
    #[must_use]
    pub fn ratio_to_quiet(&self) -> f64 {
        self.ratio_to(&self.quiet)
    }

    fn ratio_to(&self, reference: &Window) -> f64 {
        self.slow.p99.as_secs_f64() / reference.p99.as_secs_f64().max(f64::MIN_POSITIVE)
    }

    /// Returns whether the others were not slowed down.
    #[must_use]
    pub fn is_unfelt(&self) -> bool {
        self.ratio() <= RATIO_MAX
    }

    /// Machine-readable output in one line.
    #[must_use]
    pub fn json(&self) -> Value {
        let window = |window: &Window| {
            let us = |time: Duration| time.as_secs_f64() * 1e6;
            json!({
                "answers": window.count, "failed": window.failed, "p50_us": us(window.p50), "p99_us": us(window.p99),
                "max_us": us(window.max), "held_before": window.before, "held_most": window.most,
            })
        };
        json!({
            "bench": "slow_consumer", "seconds": self.plan.lasts.as_secs_f64(), "rate": self.plan.rate,
            "length": self.plan.length, "quiet": window(&self.quiet), "fast": window(&self.fast),
            "slow": window(&self.slow), "taken": self.taken, "offered": self.offered, "refused": self.refused,
            "growth": self.growth(), "bounds": self.bounds, "p99_ratio": self.ratio(),
            "p99_ratio_to_quiet": self.ratio_to_quiet(),
        })
    }
}

impl fmt::Display for Report {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        let us = |time: Duration| time.as_secs_f64() * 1e6;
        let kib = |bytes: u64| bytes >> 10;
        writeln!(
            f,
            "{:<22} {:>8} {:>6} {:>9} {:>9} {:>10} {:>12} {:>12}",
            "round trips of others",
            "answers",
            "failed",
            "p50 us",
            "p99 us",
            "max us",
            "sender KiB",
            "receiver KiB"
        )?;
        for (name, window) in
            [("no bulk", &self.quiet), ("consumer keeps up", &self.fast), ("consumer is slow", &self.slow)]
        {
            let Window { count, failed, p50, p99, max, most, .. } = window;
            writeln!(
                f,
                "{name:<22} {count:>8} {failed:>6} {:>9.1} {:>9.1} {:>10.1} {:>12} {:>12}",
                us(*p50),
                us(*p99),
                us(*max),
                kib(most[0]),
                kib(most[1])
            )?;
        }
        let ([here, there], [here_max, there_max]) = (self.growth(), self.bounds);
        writeln!(
            f,
            "sender +{} KiB of {}, receiver +{} KiB of {}; p99 {:.2} times that beside a consumer that keeps up, {:.2} \
             times that without Bulk",
            kib(here),
            kib(here_max),
            kib(there),
            kib(there_max),
            self.ratio(),
            self.ratio_to_quiet()
        )?;
        write!(
            f,
            "offered {}, refused at once {}; the slow one took {}",
            self.offered, self.refused, self.taken
        )
    }
}
