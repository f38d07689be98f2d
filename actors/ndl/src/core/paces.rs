//! The paces at which members are queried: one for each group of the configuration, and one for all others.

use std::time::Duration;

use sinew_model::config::{NdlConfig, WatchGroup};
use sinew_runtime::time::Time;

use super::{
    Member,
    grace_period::{GracePeriod, IN_A_ROW_MAX},
};

/// Index of the pace for nodes in no group, and for seeds, candidates and the multicast group. It runs as
/// long as the node does.
pub(super) const REST: usize = 0;

/// Minimum number of queries to one address that may be answered.
const ANSWERABLE_MIN: usize = 4;
/// Minimum time between two reports that the local timer is late.
const STALL_REPORT_PERIOD: Duration = Duration::from_secs(1);

/// A pace at which members are queried.
#[derive(Debug)]
pub(super) struct Pace {
    /// The watched group; `None` for nodes in no group.
    group: Option<WatchGroup>,
    pub(super) period: Duration,
    pub(super) missed_max: u32,
    /// Time of the next query to its members. `None` before the start, and for a group without members.
    due: Option<Time>,
    /// Number of cycles since the last one that counted, because the local timer was late.
    pub(super) late_in_a_row: u32,
    pub(super) grace: Option<GracePeriod>,
}

/// The start of a cycle.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Cycle {
    /// The delay of the local timer.
    pub(super) late: Duration,
    /// The delay is longer than half a period.
    pub(super) is_stall: bool,
    /// Missed answers count.
    pub(super) counts: bool,
}

impl Pace {
    const fn new(group: Option<WatchGroup>, period: Duration, missed_max: u32) -> Self {
        Self { group, period, missed_max, due: None, late_in_a_row: 0, grace: None }
    }

    /// Returns whether the node called `name` is in this pace's group.
    fn covers(&self, name: &str) -> bool {
        self.group.as_ref().is_some_and(|group| group.covers(name))
    }

    /// Returns when its next cycle is due, if it has any.
    pub(super) const fn due(&self) -> Option<Time> {
        self.due
    }

    /// Returns the number of queries to one address that may be answered: one more than may be missed, so
    /// that no answer before the loss is too late. // spec: NDL-3.1
    pub(super) fn answerable(&self) -> usize {
        // `missed_max` is 100 at most.
        ANSWERABLE_MIN.max(self.missed_max as usize + 1)
    }

    /// Returns the time for which a liveness hint is valid. // spec: NDL-4.7
    pub(super) fn hint_valid_for(&self) -> Duration {
        self.period * self.missed_max
    }

    /// Returns the loss bound: the time after its last sign of life within which a member is lost, if the
    /// local timer is on time.
    // spec: NDL-4.1
    pub(super) fn bound(&self) -> Duration {
        self.period * (self.missed_max + 1)
    }

    /// Starts the next cycle, if it is due.
    pub(super) fn next_cycle(&mut self, now: Time) -> Option<Cycle> {
        let due = self.due.filter(|due| *due <= now)?;
        let late = now.since(due);
        // Lifeguard's rule: a starved node does not suspect others. Answers that arrived meanwhile are still
        // in the socket. If the node is always starved, one cycle of four counts; otherwise no node would
        // ever be lost. spec: NDL-4.2
        let is_stall = late > self.period / 2;
        self.due = Some(if is_stall { now } else { due } + self.period);
        let is_put_off = is_stall && self.late_in_a_row < IN_A_ROW_MAX;
        self.late_in_a_row = if is_put_off { self.late_in_a_row + 1 } else { 0 };
        Some(Cycle { late, is_stall, counts: !is_put_off })
    }

    /// Stops the pace of a group without members.
    pub(super) const fn stop(&mut self) {
        self.due = None;
    }

    pub(super) const fn has_grace(&self) -> bool {
        self.grace.is_some()
    }

    /// Returns the grace period that has ended, if any.
    pub(super) fn end_grace(&mut self, now: Time) -> Option<GracePeriod> {
        self.grace.take_if(|grace| grace.until <= now)
    }

    /// Starts a grace period, if one is due after a timer that was `late`. Returns whether it did.
    pub(super) fn start_grace(&mut self, now: Time, late: Duration, former: Option<GracePeriod>) -> bool {
        self.grace = GracePeriod::after(now, late, self.period, former);
        self.has_grace()
    }
}

/// All paces. The first one is for nodes in no group.
#[derive(Debug)]
pub(super) struct Paces {
    pub(super) all: Vec<Pace>,
    stall_reported: Option<Time>,
}

impl Paces {
    pub(super) fn new(config: &NdlConfig) -> Self {
        let groups = config.watch.iter();
        let groups = groups.map(|group| Pace::new(Some(group.clone()), group.period, group.missed_max));
        let rest = Pace::new(None, config.period, config.missed_max);
        Self { all: std::iter::once(rest).chain(groups).collect(), stall_reported: None }
    }

    /// Returns the pace of nodes in no group.
    pub(super) fn rest(&self) -> &Pace {
        &self.all[REST]
    }

    /// Returns the pace of a member.
    pub(super) fn of(&self, member: &Member) -> &Pace {
        &self.all[member.pace]
    }

    /// Starts the paces that `is_used` names. Their first queries are due at once.
    pub(super) fn start(&mut self, now: Time, is_used: impl Fn(usize) -> bool) {
        for (at, pace) in self.all.iter_mut().enumerate() {
            (pace.due, pace.late_in_a_row, pace.grace) = (is_used(at).then_some(now), 0, None);
        }
    }

    /// Stops all paces.
    pub(super) fn stop(&mut self) {
        for pace in &mut self.all {
            (pace.due, pace.grace) = (None, None);
        }
    }

    /// Returns the pace of the node called `name`, and starts it if needed.
    pub(super) fn pace_for(&mut self, now: Time, name: &str) -> usize {
        let at = self.all.iter().position(|pace| pace.covers(name)).unwrap_or(REST);
        let pace = &mut self.all[at];
        pace.due.get_or_insert(now + pace.period);
        at
    }

    /// Returns whether a delay of the local timer is reported now.
    pub(super) fn reports_stall(&mut self, now: Time) -> bool {
        let is_due = self.stall_reported.is_none_or(|last| now.since(last) >= STALL_REPORT_PERIOD);
        if is_due {
            self.stall_reported = Some(now);
        }
        is_due
    }

    /// Returns when the next cycle is due, or a grace period ends.
    pub(super) fn next_wake(&self) -> Option<Time> {
        self.all.iter().flat_map(|pace| [pace.grace.map(|grace| grace.until), pace.due]).flatten().min()
    }
}
