//! The questions that freeze a span of the recordings and that fetch frozen spans, and their answers.

use serde::{Deserialize, Serialize};
use sinew_model::bounded::at_most;
use sinew_runtime::{tid::NodeAddress, wire::Payload};

use crate::question::RecordReport;

/// Maximum number of frozen spans in one answer.
pub const FROZEN_SPANS_MAX: usize = 128;
/// Maximum bytes of a frozen file in one answer.
pub const FROZEN_BYTES_MAX: usize = 32 * 1024;

/// The refusal of a question about frozen spans while the node writes to their folder. The same question succeeds some
/// milliseconds later.
pub const FROZEN_BUSY: &str = "a span is being frozen; ask again";

/// Has all nodes that record freeze the messages around this moment. [`FreezeReport`] answers.
///
/// Only a program on the node's own host, of the node's user or of root, may ask.
///
/// # Examples
///
/// ```
/// use sinew::{AppAddress, Endpoint, Tid, client::ApiError, inspect::{AskFreeze, FreezeReport}, prelude::*};
///
/// /// Returns the ID of the trigger.
/// fn freeze(endpoint: &mut Endpoint, reason: &str) -> Result<Option<String>, ApiError> {
///     let inspect = Tid::new(endpoint.tid().node, AppAddress::INSPECT);
///     let question = AskFreeze { reason: reason.to_owned() };
///     let report: FreezeReport = endpoint.message(inspect, &question).ask(Duration::from_secs(1))?;
///     Ok(report.id)
/// }
/// ```
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct AskFreeze {
    /// The cause, for users. The first 200 bytes are kept.
    #[serde(default)]
    pub reason: String,
}

impl Payload for AskFreeze {
    const NAME: &'static str = "sinew.inspect.freeze";
}

/// The trigger that has the span of an [`AskFreeze`].
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct FreezeReport {
    /// The ID of the trigger: a new one, or an earlier one with this moment in its span.
    pub id: Option<String>,
    /// Milliseconds after which the span is complete.
    pub after_ms: u64,
    /// Why nothing is frozen, as text.
    pub refused: Option<String>,
}

impl Payload for FreezeReport {
    const NAME: &'static str = "sinew.inspect.freeze_report";
}

/// A file of a frozen span.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub enum FrozenPart {
    /// The [`FrozenFacts`].
    #[default]
    Facts,
    /// The journal.
    Ring,
}

/// Asks for the frozen spans of the node, or for bytes of one. [`FrozenReport`] answers.
///
/// A program on the node's host must be of the node's user or of root. Programs of other nodes may ask; their own node
/// sends no such question of guests.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct AskFrozen {
    /// The ID of a span; `None`: a list of all.
    #[serde(default)]
    pub id: Option<String>,
    /// The file.
    #[serde(default)]
    pub part: FrozenPart,
    /// The first byte.
    #[serde(default)]
    pub offset: u64,
    /// Whether the span was fetched: its place may be given to another one.
    #[serde(default)]
    pub is_fetched: bool,
}

impl Payload for AskFrozen {
    const NAME: &'static str = "sinew.inspect.frozen";
}

/// The frozen spans of a node, or bytes of one.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct FrozenReport {
    /// The node.
    pub node: Option<NodeAddress>,
    /// The name of the node.
    pub name: String,
    /// The folder of the journal on the node's host; `None` without `record.folder`.
    pub folder: Option<String>,
    /// The folder of the frozen spans on the node's host, which may hold rings of dead nodes, too.
    #[serde(default)]
    pub frozen_folder: Option<String>,
    /// The frozen spans, if no one was asked for.
    #[serde(deserialize_with = "at_most::<_, _, FROZEN_SPANS_MAX>")]
    pub spans: Vec<FrozenSpan>,
    /// Further spans.
    pub spans_left_out: u64,
    /// Bytes of the file from the offset; at most [`FROZEN_BYTES_MAX`], none at its end.
    #[serde(with = "serde_bytes")]
    pub bytes: Vec<u8>,
    /// The length of the file.
    pub length: u64,
    /// Why there are no bytes, as text.
    pub refused: Option<String>,
}

impl Payload for FrozenReport {
    const NAME: &'static str = "sinew.inspect.frozen_report";
}

/// A frozen span of a node. Times are nanoseconds of the monotonic clock of the node's host.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct FrozenSpan {
    /// The ID of its trigger, the same on all nodes; of a node that has died, an ID of its own.
    pub id: String,
    /// The causes that the node knew, in the order of their times, and the number of those beyond eight.
    pub cause: String,
    /// The time of the trigger; 0 for a node that has died.
    pub at_ns: u64,
    /// Maximum error of that time; `u64::MAX`: unknown.
    pub bound_ns: u64,
    /// The begin of the span.
    pub begin_ns: u64,
    /// The end of the span.
    pub end_ns: u64,
    /// Bytes of the file.
    pub bytes: u64,
    /// Whether it is the whole ring of a former incarnation of the node, which has died.
    pub has_died: bool,
    /// Whether it was fetched.
    pub is_fetched: bool,
}

/// The facts beside a journal: the names for its reader, and its span if it is a frozen one.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct FrozenFacts {
    /// The span; `None` for a ring that is not frozen.
    pub span: Option<FrozenSpan>,
    /// The names that the node knew.
    pub report: RecordReport,
}
