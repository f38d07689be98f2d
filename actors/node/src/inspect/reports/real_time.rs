//! The report of a node about its real-time rights and its lateness.

use serde::{Deserialize, Serialize};
use sinew_model::bounded::at_most;

/// Maximum number of reasons in one answer.
const REFUSALS_MAX: usize = 8;

/// The real-time rights of a node, and how late a thread woke that slept to each deadline of a grid after its start.
///
/// # Examples
///
/// ```
/// use sinew::inspect::NodeReport;
///
/// /// Whether the node may have real-time threads, and woke them within 200 us.
/// fn is_proven(report: &NodeReport) -> bool {
///     report.real_time.as_ref().is_some_and(|found| found.granted > 0 && found.max_ns <= 200_000)
/// }
/// ```
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RealTimeReport {
    /// The SCHED_FIFO priority that the thread requested.
    pub wanted: u8,
    /// The priority that it had, 0 for the ordinary schedule.
    pub granted: u8,
    /// Why it did not get what it requested; empty if it did.
    #[serde(deserialize_with = "at_most::<_, _, REFUSALS_MAX>")]
    pub refusals: Vec<String>,
    /// Whether the memory of its process was locked: `locked`, `partly locked`, `not locked`.
    pub memory: String,
    /// Whether the kernel has PREEMPT_RT.
    pub is_preempt_rt: bool,
    /// Time between two deadlines.
    pub period_us: u64,
    /// Number of deadlines.
    pub turns: u64,
    /// Median lateness.
    pub p50_ns: u64,
    /// 99th percentile of the lateness.
    pub p99_ns: u64,
    /// 99.9th percentile of the lateness.
    pub p999_ns: u64,
    /// Longest lateness.
    pub max_ns: u64,
}
