//! Applications, as tools and the comparison of types read them.

use std::time::Duration;

use sinew_model::{directory::Absence, facts::DeclaredTypes};
use sinew_runtime::{
    tid::{AppAddress, Incarnation, Tid},
    wire::Kind,
};

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

/// The version of a node's list: its incarnation, and the counter of its changes. Lists of one version are the same.
pub type ListVersion = (Incarnation, u64);

/// The declared types of an application of any node.
#[derive(Clone, Debug, PartialEq, Eq)]
pub struct AppTypes {
    /// The application's address.
    pub tid: Tid,
    /// The application's name, or its address if it has none.
    pub name: String,
    /// The types.
    pub types: DeclaredTypes,
}
