//! The pause after an output that a queue without a signal of room rejected, until it is sent again.

use std::time::Duration;

use sinew_runtime::time::Time;

/// Time until an output that a queue without a signal of room rejected is sent again: the release of an
/// application, an answer to it, a frame to a peer.
pub const RETRY: Duration = Duration::from_millis(10);

/// The pause of the rejected outputs of one kind.
#[derive(Debug, Default)]
pub(super) struct RetryTimer(Option<Time>);

impl RetryTimer {
    /// Starts the pause, unless there is one.
    pub(super) fn start(&mut self, now: Time) {
        self.0.get_or_insert(now + RETRY);
    }

    /// Returns whether the pause has ended since it was started. Only the first call returns `true`.
    pub(super) fn take_expired(&mut self, now: Time) -> bool {
        self.0.take_if(|until| *until <= now).is_some()
    }

    /// Returns the end of the pause.
    pub(super) const fn next_wake(&self) -> Option<Time> {
        self.0
    }
}
