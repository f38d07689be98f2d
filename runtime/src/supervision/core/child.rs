//! One child, as its supervisor remembers it.

use std::time::Duration;

use super::{ChildId, Generation, Policy, Reason, Restart, StartRetry};
use crate::time::Time;

/// Where a child is in its life.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum ChildState {
    /// Does not live; waits for its turn, or for its release, or is not wanted.
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

/// What a supervisor knows of a child, for who asks.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct ChildView {
    /// Where it is in its life.
    pub state: ChildState,
    /// Since when.
    pub since: Time,
    /// Which life it is.
    pub generation: Generation,
    /// How often it was started again.
    pub restarts: u64,
    /// How its last life ended.
    pub last_reason: Option<Reason>,
    /// Since when it says at each start that it cannot start now.
    pub cannot_start_since: Option<Time>,
    /// Whether it should live. One that is down and should not was terminated or has ended by itself.
    pub wanted: bool,
    /// Whether its release is what it waits for.
    pub waits_for_release: bool,
    /// Former lives of it that were taken and have not let go of their threads.
    pub abandoned: usize,
}

/// What a supervisor remembers of a child.
#[derive(Debug)]
pub(super) struct Child {
    pub(super) id: ChildId,
    pub(super) policy: Policy,
    pub(super) state: ChildState,
    pub(super) since: Time,
    pub(super) generation: Generation,
    /// Should live.
    pub(super) wanted: bool,
    /// What it requires is ready. Forgotten when it ends, for then its requirements are asked for again.
    pub(super) released: bool,
    /// Lives, and must be replaced because a sibling failed.
    pub(super) stale: bool,
    /// Commands to terminate it that were not answered yet.
    pub(super) terminations: u32,
    pub(super) failures_in_a_row: u32,
    /// When it said first that it cannot start, if it has not been ready since.
    pub(super) cannot_start_since: Option<Time>,
    /// How often in a row it has said so.
    pub(super) failed_starts: u32,
    /// How often it was started.
    pub(super) starts: u64,
    pub(super) ready_since: Time,
    pub(super) last_reason: Option<Reason>,
}

impl Child {
    /// A child whose first life will follow `generation`.
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

    /// What the next life of its supervisor takes over: the past, for who asks, and a release that came since.
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

    /// The wait before the next start: doubled by each failure in a row, forgotten after a `healthy` life.
    pub(super) fn next_backoff(&mut self, now: Time, healthy: Duration) -> Duration {
        if self.ready_since > Time::ZERO && now.since(self.ready_since) > healthy {
            self.failures_in_a_row = 0;
        }
        let doublings = self.failures_in_a_row.min(20);
        self.failures_in_a_row += 1;
        self.policy.backoff_min.saturating_mul(1 << doublings).min(self.policy.backoff_max)
    }

    /// A life has ended: whether it could not start and said so, since when.
    pub(super) fn note_start(&mut self, now: Time, reason: &Reason) {
        if matches!((self.state, reason), (ChildState::Starting(_), Reason::StartFailed(_))) {
            self.cannot_start_since.get_or_insert(now);
            self.failed_starts = self.failed_starts.saturating_add(1);
        } else {
            self.can_start();
        }
    }

    /// It has started, or failed in another way.
    pub(super) const fn can_start(&mut self) {
        (self.cannot_start_since, self.failed_starts) = (None, 0);
    }

    /// The wait before it is tried again to start it, if that is no restart that counts.
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
