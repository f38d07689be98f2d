//! The reasons why a required name is not ready.

use crate::list::Ended;

/// The last known state of a name that is not ready. The order is by distance from readiness, the nearest
/// first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub enum Reason {
    NotReached,
    NotReady,
    Failed,
    Stopped,
    ListAwaited,
    NodeRestarted,
    LinkDown,
    NodeLeft,
    NodeLost,
    Unregistered,
    /// No application has the name. An earlier one may have had it: the node remembers former names only
    /// while an application requires them.
    NotThere,
    Cycle,
}

impl From<Ended> for Reason {
    fn from(ended: Ended) -> Self {
        match ended {
            Ended::Failed => Self::Failed,
            Ended::Stopped => Self::Stopped,
        }
    }
}

impl Reason {
    /// Returns the texts in `Waiting::missing`.
    pub const fn words(self) -> &'static str {
        match self {
            Self::NotReached => "has not reached this phase",
            Self::NotReady => "registered, not ready",
            Self::Failed => "failed, not ready again",
            Self::Stopped => "stopped in order, not ready again",
            Self::ListAwaited => "its node is linked again, its directory has not come yet",
            Self::NodeRestarted => "its node has restarted, its directory has not come yet",
            Self::LinkDown => "its link is down",
            Self::NodeLeft => "its node left",
            Self::NodeLost => "its node was lost",
            Self::Unregistered => "unregistered",
            Self::NotThere => "not there",
            Self::Cycle => "part of a cycle of requirements",
        }
    }

    /// Returns whether the state is intended, and nothing has failed.
    pub const fn is_orderly(self) -> bool {
        match self {
            Self::Stopped | Self::NodeLeft | Self::Unregistered => true,
            Self::NotReached
            | Self::NotReady
            | Self::Failed
            | Self::ListAwaited
            | Self::NodeRestarted
            | Self::LinkDown
            | Self::NodeLost
            | Self::NotThere
            | Self::Cycle => false,
        }
    }

    /// Returns whether the known life is over, as far as this node knows.
    pub(super) const fn is_end(self) -> bool {
        match self {
            Self::Failed
            | Self::Stopped
            | Self::NodeRestarted
            | Self::NodeLeft
            | Self::NodeLost
            | Self::Unregistered => true,
            Self::NotReached
            | Self::NotReady
            | Self::ListAwaited
            | Self::LinkDown
            | Self::NotThere
            | Self::Cycle => false,
        }
    }

    /// Returns whether the application is only unreachable at the moment, with its own state unknown.
    pub(super) const fn is_unreachable(self) -> bool {
        match self {
            Self::ListAwaited | Self::LinkDown => true,
            Self::NotReached
            | Self::NotReady
            | Self::Failed
            | Self::Stopped
            | Self::NodeRestarted
            | Self::NodeLeft
            | Self::NodeLost
            | Self::Unregistered
            | Self::NotThere
            | Self::Cycle => false,
        }
    }
}
