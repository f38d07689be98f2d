//! Why a required name is not ready.

use crate::sync::list::Ended;

/// The last that is known of a name that is not ready; the nearest to readiness comes first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(crate) enum Reason {
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
    /// Nobody has the name. Somebody may have had it before: that is remembered of names only while somebody asks for them.
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
    /// The words of `Waiting::missing`.
    pub(crate) const fn words(self) -> &'static str {
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

    /// Whether nothing has failed: somebody wanted it so.
    pub(crate) const fn is_orderly(self) -> bool {
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

    /// Whether the life that was known is over, as far as is known.
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

    /// Whether it says nothing about the application itself, only that nobody can hear of it at this moment.
    pub(super) const fn is_silence(self) -> bool {
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
