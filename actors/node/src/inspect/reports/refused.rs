//! Refused inputs and messages.

use serde::{Deserialize, Serialize};
use sinew_runtime::{tid::Tid, wire::Kind};

/// The refusals of one cause.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RefusalReport {
    /// The cause.
    pub cause: String,
    /// Number of refusals.
    pub count: u64,
    /// The detail of the last logged one.
    pub detail: String,
    /// Time since the last logged one.
    pub ago_us: u64,
}

/// Messages of one type that an application did not handle, or could not read.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct UnhandledReport {
    /// The application.
    pub receiver: Tid,
    /// Sender of the latest of them.
    pub sender: Tid,
    /// Their type.
    pub kind: Kind,
    /// Its name, if the node knows it.
    #[serde(default)]
    pub kind_name: Option<String>,
    /// Whether it cannot read them; else it does not handle the type.
    #[serde(default)]
    pub is_malformed: bool,
    /// Number of messages.
    pub count: u64,
    /// Time since the latest.
    pub ago_us: u64,
    /// The suggested fix.
    #[serde(default)]
    pub remedy: String,
}

/// Protected messages of one type that an application refused because it does not guard their sender.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct UnguardedReport {
    /// The application.
    pub receiver: Tid,
    /// The sender.
    pub sender: Tid,
    /// Their type.
    pub kind: Kind,
    /// Its name, if the node knows it.
    #[serde(default)]
    pub kind_name: Option<String>,
    /// Number of messages.
    pub count: u64,
    /// Time since the latest.
    pub ago_us: u64,
}

/// Echoes of an application that were not delivered: it guards their destination.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct LostEchoReport {
    /// The application.
    pub receiver: Tid,
    /// The sender of protected messages that it guards.
    pub guarded: Tid,
    /// The reason of the latest: the name of a [`Rejection`](sinew_runtime::outcome::Rejection). The reader of a
    /// report may be older, and not know that name.
    pub why: String,
    /// Number of echoes.
    pub count: u64,
    /// Time since the latest.
    pub ago_us: u64,
}
