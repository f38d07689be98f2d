//! Whether the child still gives signs of life.

use std::time::Duration;

use sinew_runtime::supervision::Reason;
use tokio::time::Instant;

/// Looks whether the child still gives signs of life.
pub(super) struct Watch {
    within: Option<Duration>,
    /// When it looked last.
    looked: Instant,
}

impl Watch {
    pub(super) fn new(within: Option<Duration>) -> Self {
        Self { within, looked: Instant::now() }
    }

    fn period(&self) -> Duration {
        self.within.map_or(Duration::MAX, |within| (within / 8).max(Duration::from_millis(1)))
    }

    /// Resolves when it is time to look.
    pub(super) async fn tick(&self) -> Instant {
        if self.within.is_none() {
            return std::future::pending().await;
        }
        tokio::time::sleep_until(self.looked + self.period()).await;
        Instant::now()
    }

    /// Whether the child, of which something was `heard` last then, hangs.
    pub(super) fn judge(&mut self, now: Instant, heard: &mut Option<Instant>) -> Option<Reason> {
        let lateness = now - (self.looked + self.period());
        self.looked = now;
        let (within, last) = (self.within?, (*heard)?);
        if lateness > self.period() {
            // It was this node that stood still: what came meanwhile has not been read.
            *heard = Some((last + lateness).min(now));
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
