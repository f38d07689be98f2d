//! The states of guarded outputs.

use serde::{Deserialize, Serialize};
use sinew_runtime::tid::Tid;

/// An output that an application in the node's process guards.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct GuardReport {
    /// The application that has the output.
    pub receiver: Tid,
    /// The sender of its commands.
    pub sender: Tid,
    /// The type of its commands.
    pub kind_name: String,
    /// Why it is safe: the name of a [`Cause`](sinew_runtime::protection::Cause). `None`: it is live. The reader of a
    /// report may be older, and not know that name.
    pub safe: Option<String>,
    /// Whether its safe function has failed and is retried: the output may still be live.
    pub is_safe_failed: bool,
}
