//! One child, as its supervisor remembers it.

use std::time::Duration;

use super::{ChildId, Generation, Policy};
use crate::time::Time;

/// Where a child is in its life.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChildState {
    /// Does not live; waits for its turn, or for its release.
    Down,
    /// Failed; is started again at this time.
    BackingOff(Time),
    /// Lives, is not ready, has time until then.
    Starting(Time),
    /// Lives and is ready.
    Ready,
    /// Was told to stop, has time until then.
    Stopping(Time),
}

impl ChildState {
    pub(super) const fn is_alive(self) -> bool {
        matches!(self, Self::Starting(_) | Self::Ready | Self::Stopping(_))
    }

    pub(super) const fn deadline(self) -> Option<Time> {
        match self {
            Self::BackingOff(at) | Self::Starting(at) | Self::Stopping(at) => Some(at),
            Self::Down | Self::Ready => None,
        }
    }
}

/// What a supervisor remembers of a child.
#[derive(Debug)]
pub(super) struct Child {
    pub(super) id: ChildId,
    pub(super) policy: Policy,
    pub(super) state: ChildState,
    pub(super) generation: Generation,
    /// Should live.
    pub(super) wanted: bool,
    /// What it requires is ready. Forgotten when it ends, for then its requirements are asked for again.
    pub(super) released: bool,
    /// Lives, and must be replaced because a sibling failed.
    pub(super) stale: bool,
    pub(super) failures_in_a_row: u32,
    pub(super) restarts: u64,
    pub(super) ready_since: Time,
}

impl Child {
    pub(super) const fn new(id: ChildId, policy: Policy) -> Self {
        Self {
            id,
            policy,
            state: ChildState::Down,
            generation: 0,
            wanted: false,
            released: false,
            stale: false,
            failures_in_a_row: 0,
            restarts: 0,
            ready_since: Time::ZERO,
        }
    }

    pub(super) fn waits_for_release(&self) -> bool {
        self.state == ChildState::Down && self.policy.held && !self.released
    }

    /// The wait before the next start: doubled by each failure in a row, forgotten after a `healthy` life.
    pub(super) fn next_backoff(&mut self, now: Time, healthy: Duration) -> Duration {
        if self.ready_since > Time::ZERO && now.since(self.ready_since) > healthy {
            self.failures_in_a_row = 0;
        }
        let doublings = self.failures_in_a_row.min(20);
        self.failures_in_a_row += 1;
        self.policy.backoff_min.saturating_mul(1 << doublings).min(self.policy.backoff_max)
    }
}
