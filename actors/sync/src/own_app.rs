//! An application of this node, as a tool displays it.

use std::time::Duration;

use sinew_model::directory::Absence;
use sinew_runtime::{tid::AppAddress, wire::Kind};

/// An application of this node, as a tool displays it.
pub struct OwnApp {
    /// The application's address.
    pub app: AppAddress,
    /// The application's name, if it has one.
    pub name: Option<String>,
    /// Whether the application has started and accepts messages.
    pub ready: bool,
    /// The missing requirements, since when and why.
    pub missing: Vec<Absence>,
    /// How long the application has waited at the start-up barrier or at a phase, if it waits there.
    pub waits: Option<Duration>,
    /// How the previous life ended, while this one is not ready.
    pub ended: Option<&'static str>,
    /// The payloads that the application handles, as far as it reports them.
    pub kinds: Vec<Kind>,
}
