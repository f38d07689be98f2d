//! What LNCL says to the sync manager.

use sinew_runtime::{tid::AppAddress, wire::Kind};

use super::User;

/// A change of an application of this node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum AppFact {
    /// It has an address. Its name, if it has one, the names that it requires, and whose it is: one word, so that nobody who hears of it
    /// takes a guest for one of the robot's own meanwhile.
    Registered { app: AppAddress, name: Option<String>, requires: Vec<String>, user: User },
    /// Of a registered one, the payloads that it handles, as far as it tells.
    Handles { app: AppAddress, kinds: Vec<Kind> },
    /// It has started and takes messages.
    Ready { app: AppAddress },
    /// It takes no messages: it failed and is not started again yet.
    Down { app: AppAddress },
    /// It takes no messages: it was stopped, or has ended in order.
    Stopped { app: AppAddress },
    /// It is gone.
    Unregistered { app: AppAddress },
    /// The groups that have members on this node changed.
    GroupsChanged,
}

#[cfg(test)]
impl AppFact {
    /// One of the robot's own has an address.
    pub(crate) fn own_registered(app: AppAddress, name: Option<String>, requires: Vec<String>) -> Self {
        Self::Registered { app, name, requires, user: User::Own }
    }
}
