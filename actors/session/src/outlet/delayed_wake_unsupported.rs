//! Replacement for systems without timerfd: the drain task is woken at once.

use std::task::Context;

/// The delayed wake of a connection's drain task, which is never available here.
#[derive(Debug, Default)]
pub(super) struct DelayedWake;

impl DelayedWake {
    /// Returns whether a delayed wake is scheduled: never.
    #[expect(clippy::unused_self, reason = "as where there is a timer")]
    pub(super) fn wake_later(&mut self) -> bool {
        false
    }

    /// Does nothing, because there is no timer.
    #[expect(clippy::unused_self, reason = "as where there is a timer")]
    pub(super) fn joined(&mut self) {}

    /// Does nothing, because there is no timer.
    #[expect(clippy::unused_self, reason = "as where there is a timer")]
    pub(super) fn written(&mut self) {}

    /// Does nothing, because there is no timer.
    #[expect(clippy::unused_self, reason = "as where there is a timer")]
    pub(super) fn poll(&mut self, _: &mut Context<'_>) {}
}
