//! The child's heartbeat monitor.

use std::time::Duration;

use sinew_runtime::supervision::Reason;
use tokio::time::Instant;

/// Monitors the child's heartbeats.
pub(super) struct HeartbeatTimeout {
    within: Option<Duration>,
    /// Time of the last check.
    last_check: Instant,
}

impl HeartbeatTimeout {
    pub(super) fn new(within: Option<Duration>) -> Self {
        Self { within, last_check: Instant::now() }
    }

    fn period(&self) -> Duration {
        self.within.map_or(Duration::MAX, |within| (within / 8).max(Duration::from_millis(1)))
    }

    /// Resolves at the time of the next check.
    pub(super) async fn tick(&self) -> Instant {
        if self.within.is_none() {
            return std::future::pending().await;
        }
        tokio::time::sleep_until(self.last_check + self.period()).await;
        Instant::now()
    }

    /// Returns the reason if the child hangs, by the time of its last frame, `last_frame`.
    pub(super) fn check(&mut self, now: Instant, last_frame: &mut Option<Instant>) -> Option<Reason> {
        let lateness = now - (self.last_check + self.period());
        self.last_check = now;
        let (within, last) = (self.within?, (*last_frame)?);
        if lateness > self.period() {
            // This node itself was delayed, and has not read the frames of that time.
            *last_frame = Some((last + lateness).min(now));
            return None;
        }
        let silent = now.saturating_duration_since(last);
        (silent > within).then(|| {
            let silent = silent.as_millis();
            Reason::Hung(format!(
                "no sign of life of its process for {silent} ms: it was stopped, or has no CPU"
            ))
        })
    }
}
