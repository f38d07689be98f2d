//! Inspection: every node answers questions about itself, for tools like `sinew`.
//!
//! Whoever can send a message can ask, from any node: the questions go to `node/inspect` ([`AppAddress::INSPECT`]) by
//! [`ask`](crate::client::MessageBuilder::ask), as to any application. It only reads, but for the access list, which it has read again.
//!
//! | rule | |
//! | --- | --- |
//! | INSPECT-1 | Every node has it from its start to its end, without configuration. It is in no list of applications and in no broadcast. |
//! | INSPECT-2 | One thread answers, one question after the other; 32 wait at most, 8 of guests of the node, 4 of one user; a further one is refused as `QueueFull`. After each report it rests 1 ms. No layer and no application waits for it. |
//! | INSPECT-3 | An answer has the bounds of its type, and is no longer than `node.payload_max`. What has no room is left out, last ones first, and counted (`left_out`, and of one list among others `kinds_left_out`, `barriers_left_out`, `waiting_left_out`, `missing_left_out`, `lost_left_out`, `foreign_left_out`, `refusals_left_out`). |
//! | INSPECT-4 | A kind that is no question is refused as `UnknownKind`. `sinew.ping`, confirmed, ends as `Delivered`. |
//! | INSPECT-5 | A panic in an answer costs that answer, which ends as `Failed`, and nothing else. |
//! | INSPECT-6 | A watch sees what the routing table hands over: all that an application of this node sends and gets, but for direct links between processes. At most 8 watches, 4 of guests of the node; each keeps 2,048 messages and 1 MiB of payloads until it is asked, further ones are counted as dropped. Nobody who sends waits for it. It is over 3 s after the last question, and without one it costs a sender one look at a pointer. Its answers travel as Bulk. |
//! | INSPECT-7 | The node's access list does not apply to questions. Its file is read again on the word of a program on the node's own host only; one with faults changes nothing. |
//! | INSPECT-8 | Whom a message to many reaches is what the routing table says, by the same way as that by which one goes: nothing is sent for it, so that no application gets anything, nothing is counted, and no watch shows it. |
//!
//! `docs/protocol/inspect.md` has the fields.

mod access;
mod answers;
mod inspector;
mod reach;
mod reports;
#[cfg(test)]
mod tests;
mod watches;

pub(crate) use inspector::begin;
pub use reports::{
    APPS_MAX, AccessReport, AccessVerdict, AppReport, AppsReport, AskAccess, AskApps, AskAudit, AskGroups,
    AskNode, AskReach, AskReload, AskTree, AskWatch, AuditReport, BarrierReport, CertificateReport,
    DialReport, ForeignReport, IdleReport, KindReport, LinkReport, LostReport, Missing, NodeReport,
    PEERS_MAX, PeerReport, Ping, REACHED_MAX, ReachReport, Reached, RefusalReport, ReloadReport, RouteReport,
    SEEN_BYTES_MAX, SEEN_MAX, SecurityReport, SeenMessage, SourceReport, StallReport, StreamReport, TREE_MAX,
    TreeLine, TreeReport, TroubleReport, UnhandledReport, WaitReport, WatchReport,
};

#[cfg(doc)]
use crate::AppAddress;
