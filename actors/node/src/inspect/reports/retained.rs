//! The report of a node about the values that it retains for later members of groups.

use serde::{Deserialize, Serialize};
use sinew_runtime::router::RetainedCounts;

/// The retained values of a node: its own ones, and those of other nodes. See
/// [`Payload::RETAINED`](sinew_runtime::wire::Payload::RETAINED).
///
/// # Examples
///
/// ```
/// use sinew::inspect::NodeReport;
///
/// /// Whether a later member of a group may lack a value.
/// fn has_gaps(report: &NodeReport) -> bool {
///     report.retained.is_some_and(|retained| retained.not_kept + retained.not_handed_over > 0)
/// }
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RetainedReport {
    /// Number of values that are retained now.
    pub values: u64,
    /// Bytes of these values.
    pub bytes: u64,
    /// Number of sent or received values that were beyond a bound, since the node started.
    pub not_kept: u64,
    /// Number of values that a member or node had no room for when they were handed over, since the node started.
    pub not_handed_over: u64,
}

impl From<RetainedCounts> for RetainedReport {
    fn from(counts: RetainedCounts) -> Self {
        let RetainedCounts { values, bytes, not_kept, not_handed_over } = counts;
        Self { values: values as u64, bytes: bytes as u64, not_kept, not_handed_over }
    }
}
