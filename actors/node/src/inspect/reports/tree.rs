//! The question about the supervision tree, and its answer.

use serde::{Deserialize, Serialize};
use sinew_model::bounded::at_most;
use sinew_runtime::{mailbox::AGE_BUCKETS, tid::Tid, wire::Payload};

use super::{Report, halve};

/// Maximum number of lines of a tree in one answer.
pub const TREE_MAX: usize = 1_024;

/// Asks for the supervision tree. [`TreeReport`] answers.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct AskTree {}

impl Payload for AskTree {
    const NAME: &'static str = "sinew.inspect.tree";
}

/// The supervision tree of a node, each child below its supervisor.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TreeReport {
    /// The node's name.
    pub name: String,
    /// The tree from the top, each supervisor followed by its children.
    #[serde(deserialize_with = "at_most::<_, _, TREE_MAX>")]
    pub lines: Vec<TreeLine>,
    /// Number of further ones that did not fit.
    pub left_out: u64,
}

impl Payload for TreeReport {
    const NAME: &'static str = "sinew.inspect.tree_report";
}

/// An actor or a supervisor.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct TreeLine {
    /// Number of supervisors above it.
    pub depth: u32,
    /// Its name.
    pub name: String,
    /// Its address, if it is an application.
    pub tid: Option<Tid>,
    /// Its state, as text.
    pub state: String,
    /// How long it has been in that state.
    pub since_us: u64,
    /// Its incarnation number, from 1; 0 before its first.
    pub life: u64,
    /// Number of restarts.
    pub restarts: u64,
    /// How its previous incarnation ended.
    pub last_reason: Option<String>,
    /// The name of its thread, or `own process`.
    pub place: Option<String>,
    /// Messages that wait for it.
    pub waiting: Option<u64>,
    /// Maximum number of messages that ever waited at once.
    pub waiting_most: Option<u64>,
    /// Age of the oldest one that waits; `None`: none waits, or an older version.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub oldest_us: Option<u64>,
    /// Ages of the handled ones; `None`: none was handled in the node's own process, or an older version.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub ages: Option<AgesReport>,
    /// For a supervisor: which children it restarts when one fails.
    pub strategy: Option<String>,
}

/// The ages of the delivered messages of an application when its handlers were called, as a histogram.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AgesReport {
    /// Number of messages in each bucket, with the bounds of
    /// [`AGE_BOUNDS_US`](sinew_runtime::mailbox::AGE_BOUNDS_US).
    #[serde(deserialize_with = "at_most::<_, _, AGE_BUCKETS>")]
    pub counts: Vec<u64>,
    /// Sum of all ages.
    pub sum_us: u64,
}

impl Report for TreeReport {
    fn halve(&mut self) -> bool {
        halve(&mut self.lines, &mut self.left_out)
    }
}
