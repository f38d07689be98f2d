//! The question that has a node record, and its answer.

use serde::{Deserialize, Serialize};
use sinew_model::bounded::at_most;
use sinew_runtime::{
    tid::{Incarnation, NodeAddress, Tid},
    wire::{Kind, Payload},
};

use crate::{facts::PeerClock, selection::Selection};

/// Maximum number of applications, and of payload types, in one answer.
pub const RECORDED_MAX: usize = 1_024;
/// Maximum number of clocks in one answer.
pub const CLOCKS_MAX: usize = 256;
/// Maximum number of payload types of which one question asks for the structure.
pub const SCHEMAS_MAX: usize = 32;

/// Has the node record the selected messages into its journal, or ends that. [`RecordReport`] answers.
///
/// The first question starts the recording, and each further one renews it: it ends 5 s after the last one. Only a
/// program on the node's own host, of the node's user or of root, may ask.
///
/// # Examples
///
/// ```
/// use sinew::{AppAddress, Endpoint, Tid, client::ApiError, inspect::{AskRecord, RecordReport}, prelude::*};
///
/// /// Returns the path of the journal. To be called again within 5 s for as long as it is read.
/// fn record(endpoint: &mut Endpoint, app: &str) -> Result<Option<String>, ApiError> {
///     let inspect = Tid::new(endpoint.tid().node, AppAddress::INSPECT);
///     let mut question = AskRecord::default();
///     question.selection.apps.push(app.to_owned());
///     let report: RecordReport = endpoint.message(inspect, &question).ask(Duration::from_secs(1))?;
///     Ok(report.path)
/// }
/// ```
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct AskRecord {
    /// The messages to record.
    #[serde(default)]
    pub selection: Selection,
    /// Whether the recording of this program ends now.
    #[serde(default)]
    pub ends: bool,
    /// The payload types of which the answer has the structure, as far as the node knows it.
    #[serde(default, deserialize_with = "at_most::<_, _, SCHEMAS_MAX>")]
    pub schemas: Vec<Kind>,
    /// The counters of this program's recording so far, which the node reports; `None` if it writes no file.
    #[serde(default, skip_serializing_if = "Option::is_none")]
    pub counts: Option<RecordCounts>,
}

/// The messages of a recording, as the program that writes it counts them.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecordCounts {
    /// Messages that the node has counted for it.
    pub seen: u64,
    /// Of those, the messages that are in no file.
    pub dropped: u64,
}

impl RecordCounts {
    /// Adds the counters of another recording.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew_record::RecordCounts;
    ///
    /// let mut sum = RecordCounts { seen: 5, dropped: 1 };
    /// sum.add(RecordCounts { seen: 2, dropped: 0 });
    /// assert_eq!(sum, RecordCounts { seen: 7, dropped: 1 });
    /// ```
    pub const fn add(&mut self, other: Self) {
        self.seen = self.seen.saturating_add(other.seen);
        self.dropped = self.dropped.saturating_add(other.dropped);
    }
}

impl Payload for AskRecord {
    const NAME: &'static str = "sinew.inspect.record";
}

/// The journal of a node, and the names that its reader needs.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecordReport {
    /// The path of the journal on the node's host; `None` if nothing is recorded.
    pub path: Option<String>,
    /// The node.
    pub node: Option<NodeAddress>,
    /// The name of the node.
    pub name: String,
    /// The incarnation of the node.
    pub incarnation: Option<Incarnation>,
    /// Nanoseconds from the host's monotonic clock to its wall clock.
    pub wall_offset_ns: i64,
    /// The named applications of all nodes.
    #[serde(deserialize_with = "at_most::<_, _, RECORDED_MAX>")]
    pub apps: Vec<RecordedApp>,
    /// The payload types that applications handle or send, or that are in the journal, with the names that the node
    /// knows. Those of [`AskRecord::schemas`] are the first ones.
    #[serde(deserialize_with = "at_most::<_, _, RECORDED_MAX>")]
    pub types: Vec<RecordedType>,
    /// The clocks of other nodes.
    #[serde(deserialize_with = "at_most::<_, _, CLOCKS_MAX>")]
    pub clocks: Vec<PeerClock>,
    /// Further applications.
    pub apps_left_out: u64,
    /// Further types.
    pub types_left_out: u64,
    /// Further clocks.
    pub clocks_left_out: u64,
    /// Why nothing is recorded, as text.
    pub refused: Option<String>,
}

impl RecordReport {
    /// Limits the lists to those of an answer, and counts the entries that are left out.
    #[must_use]
    pub fn bounded(mut self) -> Self {
        let cut = |length: usize, max: usize| length.saturating_sub(max) as u64;
        self.apps_left_out = cut(self.apps.len(), RECORDED_MAX);
        self.types_left_out = cut(self.types.len(), RECORDED_MAX);
        self.clocks_left_out = cut(self.clocks.len(), CLOCKS_MAX);
        self.apps.truncate(RECORDED_MAX);
        self.types.truncate(RECORDED_MAX);
        self.clocks.truncate(CLOCKS_MAX);
        self
    }
}

impl Payload for RecordReport {
    const NAME: &'static str = "sinew.inspect.record_report";
}

/// A named application.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecordedApp {
    /// Its address.
    pub tid: Tid,
    /// Its name.
    pub name: String,
}

/// A payload type.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct RecordedType {
    /// Its number.
    pub kind: Kind,
    /// Its name.
    pub name: String,
    /// Its structure, in the canonical bytes of a schema. `None` without a question for it, or if the node does
    /// not know it.
    #[serde(default, with = "serde_bytes")]
    pub schema: Option<Vec<u8>>,
}

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

#[cfg(test)]
mod tests {
    use sinew_runtime::wire::{decode, encode};

    use super::*;

    /// The question as nodes without schemas read it, and its answer as they write it.
    #[derive(Serialize, Deserialize)]
    struct Older {
        kind: Kind,
        name: String,
    }

    #[test]
    fn type_of_an_older_node_has_no_schema() {
        let kind = Kind::named("test.angle");
        let older = Older { kind, name: "test.angle".to_owned() };
        let read: RecordedType = decode(&encode(&older)).unwrap();
        assert_eq!(read, RecordedType { kind, name: "test.angle".to_owned(), schema: None });
        let newer = RecordedType { schema: Some(vec![7; 300]), ..read };
        assert_eq!(decode::<RecordedType>(&encode(&newer)).unwrap(), newer);
        assert_eq!(decode::<Older>(&encode(&newer)).unwrap().kind, kind);
    }

    #[test]
    fn question_for_too_many_schemas_is_refused() {
        let ask = |count| AskRecord { schemas: vec![Kind::from_bits(7); count], ..AskRecord::default() };
        assert!(decode::<AskRecord>(&encode(&ask(SCHEMAS_MAX))).is_ok());
        assert!(decode::<AskRecord>(&encode(&ask(SCHEMAS_MAX + 1))).is_err());
    }
}
