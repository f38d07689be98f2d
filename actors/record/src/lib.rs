//! The records in a node's journal ([`sinew_shm::journal`]), for the node that writes them and for programs that read
//! them; and the selection of the messages to record.
//!
//! | module | content |
//! | --- | --- |
//! | [`channel`] | the key of a channel: source, destination, payload type, class, form, rejection |
//! | [`entry`] | a record: a message, or one of the facts below |
//! | [`facts`] | events of nodes and applications, clock offsets, log lines |
//! | [`files`] | reads files in a folder that other users may write into |
//! | [`frozen`] | the questions that freeze a span of the recordings and that fetch one, and their answers |
//! | [`outcome`] | the outcome of a confirmed message |
//! | [`question`] | the question that has a node record, and its answer |
//! | [`tap`] | writes the selected messages of a routing table, and their outcomes |
//! | [`selection`] | applications, payload types and groups, by names and patterns |

pub mod channel;
pub mod entry;
pub mod facts;
pub mod files;
pub mod frozen;
pub mod outcome;
pub mod question;
pub mod selection;
pub mod tap;

pub use channel::{Channel, Form};
pub use entry::{Entry, EntryError, MESSAGE_HEAD, MessageEntry, fact, message_head};
pub use facts::{ClockFact, Fact, LogFact, NodeFact, PeerClock};
pub use frozen::{
    AskFreeze, AskFrozen, FROZEN_BUSY, FROZEN_BYTES_MAX, FROZEN_SPANS_MAX, FreezeReport, FrozenFacts,
    FrozenPart, FrozenReport, FrozenSpan,
};
pub use outcome::OutcomeEntry;
pub use question::{
    AskRecord, CLOCKS_MAX, RECORDED_MAX, RecordCounts, RecordReport, RecordedApp, RecordedType,
    RecordingReport, SCHEMAS_MAX,
};
pub use selection::{Chosen, Selection, SelectionError};
pub use tap::{OutcomeTap, RecordTap, lost_channel};
