//! An address that NDL exchanges datagrams with: its sources, the queries sent there, and the node that answers.

use std::collections::BTreeMap;

use sinew_model::rate_limiter::RateLimiter;
use sinew_runtime::{tid::NodeAddress, time::Time};

use super::{Source, budget::KNOWN, queries::SentQueries};

/// The kind of node at an address.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Role {
    /// No node has answered yet. `queried` is the number of queries of the cycle.
    Candidate { queried: u32 },
    /// A member.
    Member(NodeAddress),
    /// A departed node. It is queried with increasing intervals: after `left` cycles, and then after `wait`.
    Former { node: NodeAddress, wait: u32, left: u32 },
}

/// An address that NDL exchanges datagrams with.
#[derive(Debug)]
pub(super) struct Contact {
    pub(super) role: Role,
    /// Whether the configuration lists the address. It is then queried forever.
    pub(super) is_seed: bool,
    /// Time since which this address has been known.
    pub(super) since: Time,
    pub(super) sources: BTreeMap<Source, Time>,
    pub(super) queries: SentQueries,
    /// Time of the last query that a received datagram caused.
    pub(super) queried_on_receipt: Option<Time>,
    /// Budget of received datagrams. Only members and seeds have a budget of their own.
    pub(super) budget: RateLimiter,
    /// Budget of answers to this node's queries.
    pub(super) answers: RateLimiter,
}

impl Contact {
    pub(super) fn new(now: Time, source: Source) -> Self {
        Self {
            role: Role::Candidate { queried: 0 },
            is_seed: false,
            since: now,
            sources: BTreeMap::from([(source, now)]),
            queries: SentQueries::default(),
            queried_on_receipt: None,
            budget: RateLimiter::new(KNOWN),
            answers: RateLimiter::new(KNOWN),
        }
    }

    /// Creates the contact of an address in the configuration.
    pub(super) fn seed(now: Time) -> Self {
        Self { is_seed: true, ..Self::new(now, Source::Seed) }
    }

    /// Creates the contact of an address that only a member announces. The announcement may be forged, so it
    /// does not count as a source.
    pub(super) fn announced(now: Time) -> Self {
        Self { sources: BTreeMap::new(), ..Self::new(now, Source::Query) }
    }

    /// Creates the contact of an address at which a lost node may be.
    pub(super) fn former(now: Time, node: NodeAddress) -> Self {
        let role = Role::Former { node, wait: 1, left: 0 };
        Self { role, ..Self::announced(now) }
    }

    /// Creates the contact of an address at which a node was before this one was restarted.
    pub(super) fn remembered(now: Time, node: NodeAddress) -> Self {
        Self { sources: BTreeMap::from([(Source::Remembered, now)]), ..Self::former(now, node) }
    }

    /// Records that a source names the address, possibly again, or just before it is forgotten.
    pub(super) fn named_by(&mut self, now: Time, source: Source) {
        self.sources.entry(source).or_insert(now);
        if let Role::Candidate { queried } = &mut self.role {
            *queried = 0;
        }
    }

    /// Returns whether a candidate was queried `missed_max` times since it was last named. A seed is never dropped.
    pub(super) const fn has_missed(&self, missed_max: u32) -> bool {
        matches!(self.role, Role::Candidate { queried } if queried >= missed_max) && !self.is_seed
    }

    /// Returns whether only the memory names this address: no datagram was received from there since, and it
    /// is not listed.
    pub(super) fn is_remembered_alone(&self) -> bool {
        let is_asked_for_it = matches!(self.role, Role::Candidate { .. } | Role::Former { .. });
        is_asked_for_it && !self.is_seed && self.sources.keys().eq(&[Source::Remembered])
    }

    pub(super) fn is_former_of(&self, node: NodeAddress) -> bool {
        matches!(self.role, Role::Former { node: former, .. } if former == node)
    }

    pub(super) fn is_candidate(&self) -> bool {
        matches!(self.role, Role::Candidate { .. }) && !self.is_seed && !self.is_announced_only()
    }

    /// Returns whether only a member announces this address, and no datagram was received from it. Such
    /// contacts have a limit of their own.
    pub(super) fn is_announced_only(&self) -> bool {
        matches!(self.role, Role::Candidate { .. }) && !self.is_seed && self.sources.is_empty()
    }

    /// Returns whether its datagrams count against its own budget, not that of unknown addresses.
    pub(super) const fn has_own_budget(&self) -> bool {
        matches!(self.role, Role::Member(_)) || self.is_seed
    }
}
