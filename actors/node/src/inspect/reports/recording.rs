//! The state of a node's recording.

use serde::{Deserialize, Serialize};

/// The state of a node's recording: its journal, and the files of the programs that read it.
///
/// # Examples
///
/// ```
/// use sinew::inspect::NodeReport;
///
/// /// Whether a file of this node's messages lacks some.
/// fn has_gaps(report: &NodeReport) -> bool {
///     report.recording.is_some_and(|recording| recording.dropped > 0)
/// }
/// ```
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecordingReport {
    /// Whether the configuration asks for a recording.
    pub is_configured: bool,
    /// Number of programs that record now.
    pub programs: u32,
    /// Bytes that were written to the present journal; 0 without one.
    pub written_bytes: u64,
    /// Messages that files of recordings were to have since the node started, as their programs have reported.
    pub seen: u64,
    /// Of those, the messages that are in no file.
    pub dropped: u64,
}
