//! Destinations of messages that an ended incarnation of a peer may still deliver: its end is reported behind them.

use std::collections::BTreeSet;

use sinew_runtime::tid::AppAddress;

/// The destinations that may still receive a message from an incarnation that has left or ended.
#[derive(Debug, PartialEq, Eq)]
pub enum OutstandingDestinations {
    /// Any application: a thread is processing a message, or more may arrive.
    All,
    /// The applications at these addresses.
    Some(BTreeSet<AppAddress>),
}

impl OutstandingDestinations {
    pub(super) const NONE: Self = Self::Some(BTreeSet::new());

    pub(super) fn union(self, other: Self) -> Self {
        match (self, other) {
            (Self::Some(mut some), Self::Some(others)) => {
                some.extend(others);
                Self::Some(some)
            }
            (Self::All, Self::All | Self::Some(_)) | (Self::Some(_), Self::All) => Self::All,
        }
    }

    pub fn contains(&self, app: AppAddress) -> bool {
        match self {
            Self::All => true,
            Self::Some(apps) => apps.contains(&app),
        }
    }
}
