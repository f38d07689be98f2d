//! What messages a peer's life may leave behind, and for whom: an end is told behind them.

use std::collections::BTreeSet;

use sinew_runtime::tid::AppAddress;

/// To whom a message of a life that has left or is over may still come.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Owed {
    /// Any application: one is in the hand of a thread, or more may come.
    Anyone,
    /// Those at these addresses.
    These(BTreeSet<AppAddress>),
}

impl Owed {
    pub(super) const NOBODY: Self = Self::These(BTreeSet::new());

    pub(super) fn and(self, other: Self) -> Self {
        match (self, other) {
            (Self::These(mut some), Self::These(others)) => {
                some.extend(others);
                Self::These(some)
            }
            (Self::Anyone, Self::Anyone | Self::These(_)) | (Self::These(_), Self::Anyone) => Self::Anyone,
        }
    }

    pub(crate) fn has(&self, app: AppAddress) -> bool {
        match self {
            Self::Anyone => true,
            Self::These(apps) => apps.contains(&app),
        }
    }
}
