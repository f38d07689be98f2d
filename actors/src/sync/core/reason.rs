//! Why a required name is not ready.

/// The last that is known of a name that is not ready; the nearest to readiness comes first.
#[derive(Clone, Copy, Debug, PartialEq, Eq, PartialOrd, Ord)]
pub(super) enum Reason {
    NotReady,
    Failed,
    ListAwaited,
    LinkDown,
    NodeLeft,
    NodeLost,
    Unregistered,
    NeverSeen,
    Cycle,
}

impl Reason {
    /// The words of `Waiting::missing`.
    pub(super) const fn words(self) -> &'static str {
        match self {
            Self::NotReady => "registered, not ready",
            Self::Failed => "failed, not ready again",
            Self::ListAwaited => "its node is linked again, its directory has not come yet",
            Self::LinkDown => "its link is down",
            Self::NodeLeft => "its node left",
            Self::NodeLost => "its node was lost",
            Self::Unregistered => "unregistered",
            Self::NeverSeen => "never seen",
            Self::Cycle => "part of a cycle of requirements",
        }
    }
}
