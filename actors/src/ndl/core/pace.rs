//! How often members are asked: a pace for each group of the configuration, and one for all others.

use std::time::Duration;

use sinew_runtime::time::Time;

use super::cycle::Respite;
use crate::config::{NdlConfig, WatchGroup};

/// The pace of whoever is in no group, and of seeds, candidates and the multicast group. It runs as long as the node does.
pub(super) const REST: usize = 0;

/// Queries to one address that may be answered, at least.
const ANSWERABLE_MIN: usize = 4;

/// A pace at which members are asked.
#[derive(Debug)]
pub(super) struct Pace {
    /// Who is watched at it; `None` for the rest.
    group: Option<WatchGroup>,
    pub(super) period: Duration,
    pub(super) missed_max: u32,
    /// When its members are asked next; `None` while nothing runs, and in a group while it has no members.
    pub(super) due: Option<Time>,
    /// Cycles since the last one that counted, as our own timer was late.
    pub(super) late_in_a_row: u32,
    pub(super) respite: Option<Respite>,
}

impl Pace {
    /// That of the rest, then those of the groups.
    pub(super) fn all_of(config: &NdlConfig) -> Vec<Self> {
        let pace = |group, period, missed_max| Self {
            group,
            period,
            missed_max,
            due: None,
            late_in_a_row: 0,
            respite: None,
        };
        let groups =
            config.watch.iter().map(|group| pace(Some(group.clone()), group.period, group.missed_max));
        std::iter::once(pace(None, config.period, config.missed_max)).chain(groups).collect()
    }

    /// Whether the node called `name` is in this pace's group.
    pub(super) fn covers(&self, name: &str) -> bool {
        self.group.as_ref().is_some_and(|group| group.covers(name))
    }

    /// Queries to one address that may be answered: as many as may be missed and one more, so that no answer that comes before the loss
    /// comes too late. // spec: NDL-3.1
    pub(super) fn answerable(&self) -> usize {
        // `missed_max` is 100 at most.
        ANSWERABLE_MIN.max(self.missed_max as usize + 1)
    }

    /// How long a sign of life counts. // spec: NDL-4.7
    pub(super) fn sign_counts_for(&self) -> Duration {
        self.period * self.missed_max
    }

    /// Time after its last sign of life within which a member is lost, if our own timer is on time. // spec: NDL-4.1
    pub(super) fn bound(&self) -> Duration {
        self.period * (self.missed_max + 1)
    }
}
