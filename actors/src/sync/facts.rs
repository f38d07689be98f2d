//! What the sync manager says to applications and to the node's root.

use std::time::Duration;

use serde::{Deserialize, Serialize};
use sinew_runtime::wire::{Class, Payload};

/// A requirement changed. Applications that require something and handle this payload get it from their node's sync
/// manager.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub enum RequirementEvent {
    /// What this application requires is not ready any more.
    Lost {
        /// The name that it requires.
        name: String,
    },
    /// It is ready again.
    Met {
        /// The name that it requires.
        name: String,
    },
}

impl Payload for RequirementEvent {
    const NAME: &'static str = "sinew.requirement_event";
    const CLASS: Class = Class::Control;
}

/// An application that waits at the start-up barrier.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct Waiting {
    /// The application's name, or its address where it has none.
    pub application: String,
    /// The names that are not ready, and the last that is known of each: `never seen`, `registered, not ready`,
    /// `its node was lost`.
    pub missing: Vec<(String, &'static str)>,
    /// How long it has waited.
    pub since: Duration,
}
