//! What LNCL says to the sync manager.

use sinew_runtime::{tid::AppAddress, wire::Kind};

/// A change of an application of this node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(crate) enum AppFact {
    /// It has an address. Its name, if it has one, and the names that it requires.
    Registered { app: AppAddress, name: Option<String>, requires: Vec<String> },
    /// A registered one is a guest's: this user's, whom the access list lets in. Said behind the registration, before it can send anything.
    Guest { app: AppAddress, uid: u32 },
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
