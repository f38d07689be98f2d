//! Inspection: every node answers questions about itself, for tools like `sinew`.
//!
//! Any application that can send a message can ask, from any node. The questions go to `node/inspect`
//! ([`AppAddress::INSPECT`]) by `ask`, as to any application. Inspection only
//! reads; the exceptions are that it can make the node read its access list again, that it starts and ends recordings,
//! and that it freezes the messages around a moment.
//!
//! | rule | |
//! | --- | --- |
//! | INSPECT-1 | Every node answers from its start to its end, without configuration. The address is in no list of applications and in no broadcast. |
//! | INSPECT-2 | One thread answers, one question after the other. At most 32 questions are queued, 8 of guests of the node, 4 of one user; a further one is refused as `QueueFull`. After each report the thread pauses for 1 ms. No layer and no application waits for it. |
//! | INSPECT-3 | An answer has the bounds of its type, and is at most `node.payload_max` long. Entries that do not fit are left out, last ones first, and counted (`left_out`, and for one list among others `kinds_left_out`, `barriers_left_out`, `waiting_left_out`, `missing_left_out`, `groups_left_out`, `lost_left_out`, `foreign_left_out`, `refusals_left_out`). |
//! | INSPECT-4 | A kind that is no question is refused as `UnknownKind`. `sinew.ping`, confirmed, ends as `Delivered`. |
//! | INSPECT-5 | A panic in an answer costs that answer, which ends as `Failed`, and nothing else. |
//! | INSPECT-6 | A watch records the messages that the routing table delivers: all that an application of this node sends and gets, except on direct links between processes. There are at most 8 watches, 4 of guests of the node. Each keeps 2,048 messages and 1 MiB of payloads until the next question; further ones are counted as dropped. No sender waits for it. It ends 3 s after the last question, and without a watch it costs a sender one pointer check. Its answers have class Bulk. |
//! | INSPECT-7 | The node's access list does not apply to questions. Only a program on the node's own host can request that its file is read again; a file with faults changes nothing. |
//! | INSPECT-8 | The applications that a message to many reaches are computed from the routing table by the same code that delivers such a message. Nothing is sent, so no application gets a message, nothing is counted, and no watch shows it. |
//! | INSPECT-9 | A recording is started by a program of the node's own host and user, or of root, for at most 8 of them, and ends 5 s after its last question. It writes the selected messages into a journal. The answer has its path, and the structure of at most 32 payload types that the question names. No sender waits for it. |
//! | INSPECT-10 | A span is frozen for a program of the node's own host and user, or of root. Frozen spans are read by such programs, and by programs of other nodes. A node sends such a question of a guest to no other node. |
//! | INSPECT-11 | A node hands out the newest lines of its log, of any level that is logged: at most 2,048 lines and 256 KiB of text are kept. An answer has at most 256 lines and 32 KiB of text, from the requested number on, and counts the lines that are not kept. No thread that logs waits for it. |
//! | INSPECT-12 | A node hands out the contracts of its applications, and the outputs that these guard in its process: at most 256 of each. Nothing is checked or measured for an answer. |
//!
//! `docs/protocol/inspect.md` lists the fields.

mod access;
mod answers;
mod contracts;
mod frozen;
mod inspector;
mod logs;
mod reach;
mod record;
mod refused;
mod reports;
#[cfg(test)]
mod tests;
mod types;
mod watches;

pub(crate) use contracts::Contracts;
pub(crate) use inspector::begin;
#[cfg(test)]
pub(crate) use record::recorded;
pub use reports::{
    APPS_MAX, AccessReport, AccessVerdict, AgesReport, AppReport, AppsReport, AskAccess, AskApps, AskAudit,
    AskFreeze, AskFrozen, AskGroups, AskLogs, AskMismatches, AskNode, AskReach, AskRecord, AskReload,
    AskSchemas, AskTree, AskWatch, AuditReport, BarrierReport, CertificateReport, DialReport, FROZEN_BUSY,
    FROZEN_BYTES_MAX, FROZEN_SPANS_MAX, ForeignReport, FreezeReport, FrozenFacts, FrozenPart, FrozenReport,
    FrozenSpan, GroupReport, GuardReport, IdleReport, KindReport, LOG_LINES_MAX, LinkReport, LogLine,
    LogsReport, LostEchoReport, LostReport, MismatchReport, MismatchesReport, Missing, NodeReport, PEERS_MAX,
    PeerReport, Ping, REACHED_MAX, RECORDED_MAX, ReachReport, Reached, RealTimeReport, RecordCounts,
    RecordReport, RecordedApp, RecordedType, RecordingReport, RefusalReport, ReloadReport, RetainedReport,
    RouteReport, SCHEMAS_MAX, SEEN_BYTES_MAX, SEEN_MAX, SchemaReport, SchemasReport, SecurityReport,
    SeenMessage, SourceReport, StallReport, StreamReport, TREE_MAX, TreeLine, TreeReport, TroubleReport,
    TypeUser, UnguardedReport, UnhandledReport, WaitReport, WatchReport,
};
pub use sinew_record::{PeerClock, Selection};
pub use sinew_runtime::mailbox::{AGE_BOUNDS_US, AGE_BUCKETS};

#[cfg(doc)]
use sinew_runtime::tid::AppAddress;
