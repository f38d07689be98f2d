//! The state of one child of a supervisor.

use std::time::Duration;

use super::{ChildId, Generation, Policy, Reason, Restart, StartRetry};
use crate::time::Time;

/// The state of a child in its life cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChildState {
    /// Not alive: waits for its turn or its release, or is not wanted.
    Down,
    /// Failed, and will be started again at this time.
    BackingOff(Time),
    /// Alive and not ready, with this deadline.
    Starting(Time),
    /// Alive and ready.
    Ready,
    /// Ordered to stop, with this deadline.
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

/// The state of a child, for queries.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ChildView {
    /// The current state.
    pub state: ChildState,
    /// When the current state began.
    pub since: Time,
    /// The current generation.
    pub generation: Generation,
    /// The number of restarts.
    pub restarts: u64,
    /// The reason for the end of its last incarnation.
    pub last_reason: Option<Reason>,
    /// When the first of its consecutive failed starts was, if there is one.
    pub cannot_start_since: Option<Time>,
    /// Whether the child should be alive. A child that is down and not wanted was terminated or has ended by itself.
    pub wanted: bool,
    /// Whether the child waits for its release.
    pub waits_for_release: bool,
    /// The number of its abandoned incarnations that have not released their threads.
    pub abandoned: usize,
}

/// The state of a child, as its supervisor keeps it.
#[derive(Debug)]
pub(super) struct Child {
    pub(super) id: ChildId,
    pub(super) policy: Policy,
    pub(super) state: ChildState,
    pub(super) since: Time,
    pub(super) generation: Generation,
    /// Whether the child should be alive.
    pub(super) wanted: bool,
    /// Whether its requirements are ready. Cleared when the child ends, because they are checked again then.
    pub(super) released: bool,
    /// Whether the child is alive and must be replaced because a sibling failed.
    pub(super) stale: bool,
    /// The number of unanswered commands to terminate the child.
    pub(super) terminations: u32,
    pub(super) failures_in_a_row: u32,
    /// When its first consecutive start failed, if it has not been ready since.
    pub(super) cannot_start_since: Option<Time>,
    /// The number of consecutive failed starts.
    pub(super) failed_starts: u32,
    /// The number of starts.
    pub(super) starts: u64,
    pub(super) ready_since: Time,
    pub(super) last_reason: Option<Reason>,
}

impl Child {
    /// Creates a child; its first incarnation follows `generation`.
    pub(super) const fn new(id: ChildId, policy: Policy, generation: Generation) -> Self {
        Self {
            id,
            policy,
            state: ChildState::Down,
            since: Time::ZERO,
            generation,
            wanted: false,
            released: false,
            stale: false,
            terminations: 0,
            failures_in_a_row: 0,
            cannot_start_since: None,
            failed_starts: 0,
            starts: 0,
            ready_since: Time::ZERO,
            last_reason: None,
        }
    }

    /// Takes over state from the previous incarnation of its supervisor: the history, for queries, and a release since.
    pub(super) fn renew(&mut self, former: Option<&Self>) {
        let Some(former) = former else { return };
        self.released = former.released;
        self.starts = former.starts;
        self.last_reason.clone_from(&former.last_reason);
        self.since = former.since;
    }

    pub(super) const fn enter(&mut self, state: ChildState, now: Time) {
        self.state = state;
        self.since = now;
    }

    pub(super) fn is_temporary(&self) -> bool {
        self.policy.restart == Restart::Temporary
    }

    pub(super) fn waits_for_release(&self) -> bool {
        self.state == ChildState::Down && self.policy.held && !self.released
    }

    /// Returns the wait before the next start: doubled by each consecutive failure, reset after an
    /// incarnation that lasted for `healthy`.
    pub(super) fn next_backoff(&mut self, now: Time, healthy: Duration) -> Duration {
        if self.ready_since > Time::ZERO && now.since(self.ready_since) > healthy {
            self.failures_in_a_row = 0;
        }
        let doublings = self.failures_in_a_row.min(20);
        self.failures_in_a_row += 1;
        self.policy.backoff_min.saturating_mul(1 << doublings).min(self.policy.backoff_max)
    }

    /// Records the end of an incarnation: whether its start failed explicitly, and since when.
    pub(super) fn note_start(&mut self, now: Time, reason: &Reason) {
        if matches!((self.state, reason), (ChildState::Starting(_), Reason::StartFailed(_))) {
            self.cannot_start_since.get_or_insert(now);
            self.failed_starts = self.failed_starts.saturating_add(1);
        } else {
            self.can_start();
        }
    }

    /// Records a start, or a failure of another kind.
    pub(super) const fn can_start(&mut self) {
        (self.cannot_start_since, self.failed_starts) = (None, 0);
    }

    /// Returns the wait before the next retry of a start, if the retry does not count as a restart.
    pub(super) fn start_retry(&self, now: Time) -> Option<Duration> {
        let since = self.cannot_start_since?;
        let StartRetry { wait_min, wait_max, give_up_after } = self.policy.start_retry;
        let doublings = self.failed_starts.saturating_sub(1).min(20);
        let is_tried = give_up_after.is_none_or(|time| now.since(since) < time);
        is_tried.then(|| wait_min.saturating_mul(1 << doublings).min(wait_max))
    }

    pub(super) fn view(&self, abandoned: usize) -> ChildView {
        ChildView {
            state: self.state,
            since: self.since,
            generation: self.generation,
            restarts: self.starts.saturating_sub(1),
            last_reason: self.last_reason.clone(),
            cannot_start_since: self.cannot_start_since,
            wanted: self.wanted,
            waits_for_release: self.wanted && self.waits_for_release(),
            abandoned,
        }
    }
}
