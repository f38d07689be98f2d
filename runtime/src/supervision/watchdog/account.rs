//! The account of time in which a thread got no CPU, from the system's clock and from the kernel.

use std::time::Duration;

use super::processor::{Condition, Sample};

/// The time in which a thread got no CPU, since the account was opened.
#[derive(Clone, Copy, Debug, Default)]
pub(super) struct Account {
    /// The lateness of the watchdog itself.
    pub(super) late: Duration,
    first: Option<Sample>,
    last: Option<Sample>,
}

impl Account {
    /// Creates an account that begins with this lateness.
    pub(super) fn opened(late: Duration) -> Self {
        Self { late, ..Self::default() }
    }

    /// Records a sample. Returns whether the thread waits for a CPU at this moment.
    pub(super) fn enter(&mut self, sample: Option<Sample>) -> bool {
        let Some(sample) = sample else { return false };
        let former = self.last.replace(sample);
        self.first.get_or_insert(sample);
        match sample.condition {
            Condition::Stopped => true,
            Condition::Runnable => {
                former.is_some_and(|former| (former.ran, former.waited) == (sample.ran, sample.waited))
            }
            Condition::Blocked => false,
        }
    }

    pub(super) fn excused(&self) -> Duration {
        self.late + self.waited()
    }

    /// Returns the time for which the thread waited for a CPU.
    pub(super) fn waited(&self) -> Duration {
        let waited = match (self.first, self.last) {
            (Some(first), Some(last)) => last.waited.saturating_sub(first.waited),
            (None, _) | (_, None) => 0,
        };
        Duration::from_nanos(waited)
    }
}
