//! How the nodes of a case watch each other.

use std::time::Duration;

use sinew::{NodeConfig, config::WatchGroup};

/// Default maximum of consecutive missed answers, for every setting.
const MISSED_MAX: u32 = 3;
/// Minimum time between two progress checks, as in `actors/ndl/src/actor.rs`.
const PROGRESS_PERIOD_MIN: Duration = Duration::from_millis(100);
/// Duration of a turn that is reported as stalled, as in docs/protocol/ndl.md.
const STALLED: Duration = Duration::from_millis(250);

/// Interval of the queries between nodes.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) enum Setting {
    /// Every 500 ms, as they do by default.
    Relaxed,
    /// Every 50 ms.
    Brisk,
    /// Every 10 ms, as a group of `ndl.watch`; all else every 500 ms.
    Leg,
}

impl Setting {
    pub(crate) const ALL: [Self; 3] = [Self::Relaxed, Self::Brisk, Self::Leg];

    /// The name as part of the names of cases.
    pub(crate) const fn name(self) -> &'static str {
        match self {
            Self::Relaxed => "500ms",
            Self::Brisk => "50ms",
            Self::Leg => "leg_10ms",
        }
    }

    pub(crate) fn named(name: &str) -> Self {
        let found = Self::ALL.into_iter().find(|setting| setting.name() == name);
        found.expect("a name that this program wrote itself")
    }

    /// The node's own period.
    const fn period(self) -> Duration {
        match self {
            Self::Relaxed | Self::Leg => Duration::from_millis(500),
            Self::Brisk => Duration::from_millis(50),
        }
    }

    /// Time between two queries to one node.
    pub(crate) const fn asked_every(self) -> Duration {
        match self {
            Self::Relaxed | Self::Brisk => self.period(),
            Self::Leg => Duration::from_millis(10),
        }
    }

    /// Time within which a node that falls silent is lost.
    pub(crate) fn loss_bound(self) -> Duration {
        self.asked_every() * (MISSED_MAX + 1)
    }

    /// Bound on the report of a turn that does not end: the turn lasts this long, then the node is checked,
    /// and then queried.
    pub(crate) fn stall_bound(self) -> Duration {
        STALLED + self.period().max(PROGRESS_PERIOD_MIN) + self.asked_every()
    }

    pub(crate) fn write_to(self, config: &mut NodeConfig) {
        let ndl = &mut config.ndl;
        (ndl.period, ndl.missed_max) = (self.period(), MISSED_MAX);
        if self == Self::Leg {
            let (nodes, period) = (vec!["*".to_owned()], self.asked_every());
            ndl.watch = vec![WatchGroup { nodes, period, missed_max: MISSED_MAX }];
        }
    }
}
