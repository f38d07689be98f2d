//! The question about the messages of a watched application, and its answer.

use serde::{Deserialize, Serialize};
use sinew_model::bounded::at_most;
use sinew_runtime::{
    outcome::Rejection,
    tid::Tid,
    wire::{Class, Kind, Payload},
};

use super::{Report, halve};

/// Maximum number of messages of a watched application in one answer.
pub const SEEN_MAX: usize = 256;
/// Longest payload shown to a watcher, in bytes; for a longer one only its length is shown.
pub const SEEN_BYTES_MAX: usize = 16 * 1024;

/// Asks for the messages that this application of the node has received and sent since the last question.
/// [`WatchReport`] answers.
///
/// The first question starts the watch, and its answer is empty. The watch ends 3 s after the last question.
///
/// # Examples
///
/// ```
/// use sinew::{AppAddress, Endpoint, Tid, client::ApiError, inspect::{AskWatch, WatchReport}, prelude::*};
///
/// /// Returns the messages to the application since the last call. The first call begins the watch.
/// fn watch(endpoint: &mut Endpoint, app: Tid) -> Result<WatchReport, ApiError> {
///     let inspect = Tid::new(app.node, AppAddress::INSPECT);
///     let question = AskWatch { app, received: true, sent: false };
///     endpoint.message(inspect, &question).ask(Duration::from_secs(1))
/// }
/// ```
#[derive(Clone, Copy, Debug, Serialize, Deserialize)]
pub struct AskWatch {
    /// The application.
    pub app: Tid,
    /// Whether to record the messages that it receives.
    pub received: bool,
    /// Whether to record the messages that it sends.
    pub sent: bool,
}

impl Payload for AskWatch {
    const NAME: &'static str = "sinew.inspect.watch";
}

/// The messages that an application received and sent.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
pub struct WatchReport {
    /// In the order in which they were recorded.
    #[serde(deserialize_with = "at_most::<_, _, SEEN_MAX>")]
    pub seen: Vec<SeenMessage>,
    /// Number of messages dropped since the last answer.
    pub dropped: u64,
    /// Whether more messages wait for the next question.
    pub more: bool,
    /// Why there is no watch, as text.
    pub refused: Option<String>,
}

impl Payload for WatchReport {
    const NAME: &'static str = "sinew.inspect.watch_report";
}

/// A message that the routing table of a node delivered or refused.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct SeenMessage {
    /// Time since then.
    pub seen_us: u64,
    /// Its age at that time, in nanoseconds; `None` if unknown.
    #[serde(default)]
    pub age_ns: Option<u64>,
    /// Maximum error of the age: 0 for a message of the node's host, `None` if the age is unknown.
    #[serde(default)]
    pub age_error_ns: Option<u64>,
    /// Whether the application sent it; else it was the destination.
    pub is_sent: bool,
    /// The sender.
    pub source: Tid,
    /// The destination; for a group, its members receive it, too.
    pub target: Tid,
    /// Type of its payload.
    pub kind: Kind,
    /// The name of the type, if the node knows it.
    pub name: Option<String>,
    /// Its class.
    pub class: Class,
    /// Its sequence number at the source.
    pub sequence: u64,
    /// `confirm`, `ask`, `reply` or nothing: the sender's request to the receiver.
    pub wants: Option<String>,
    /// Length of its payload in bytes.
    pub length: u64,
    /// The payload, unless it is longer than [`SEEN_BYTES_MAX`].
    #[serde(with = "serde_bytes")]
    pub payload: Vec<u8>,
    /// Why it was refused; else a queue or a connection has accepted it.
    pub refused: Option<Rejection>,
}

/// Its class yields to all messages that the application sends and receives.
impl Report for WatchReport {
    const TRAVELS: Class = Class::Bulk;

    fn halve(&mut self) -> bool {
        halve(&mut self.seen, &mut self.dropped)
    }
}
