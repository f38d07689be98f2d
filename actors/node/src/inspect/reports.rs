//! The questions and their answers. Times are microseconds before the answer was made, unless a name states otherwise.

mod access;
mod apps;
mod audit;
mod contracts;
mod frozen;
mod guards;
mod logs;
mod node;
mod peers;
mod reach;
mod real_time;
mod record;
mod refused;
mod retained;
mod security;
mod tree;
mod types;
mod watch;

pub use access::{AccessReport, AccessVerdict, AskAccess, AskReload, ReloadReport};
pub use apps::{APPS_MAX, AppReport, AppsReport, AskApps, BarrierReport, KindReport, Missing, WaitReport};
pub use audit::{AskAudit, AuditReport};
pub use guards::GuardReport;
pub use logs::{AskLogs, LOG_LINES_MAX, LogLine, LogsReport};
pub use node::{AskNode, NodeReport, PEERS_MAX};
pub use peers::{
    DialReport, ForeignReport, IdleReport, LinkReport, LostReport, PeerReport, RouteReport, SourceReport,
    StallReport, StreamReport, TroubleReport,
};
pub use reach::{AskGroups, AskReach, GroupReport, REACHED_MAX, ReachReport, Reached};
pub use real_time::RealTimeReport;
pub use refused::{LostEchoReport, RefusalReport, UnguardedReport, UnhandledReport};
pub use retained::RetainedReport;
pub use security::{CertificateReport, SecurityReport};
pub use tree::{AgesReport, AskTree, TREE_MAX, TreeLine, TreeReport};
pub use types::{
    AskMismatches, AskSchemas, MismatchReport, MismatchesReport, SchemaReport, SchemasReport, TypeUser,
};
pub use watch::{AskWatch, SEEN_BYTES_MAX, SEEN_MAX, SeenMessage, WatchReport};

use serde::Serialize;
pub use sinew_model::ping::Ping;
pub use sinew_record::{
    AskFreeze, AskFrozen, AskRecord, FROZEN_BUSY, FROZEN_BYTES_MAX, FROZEN_SPANS_MAX, FreezeReport,
    FrozenFacts, FrozenPart, FrozenReport, FrozenSpan, RECORDED_MAX, RecordCounts, RecordReport, RecordedApp,
    RecordedType, RecordingReport, SCHEMAS_MAX,
};
use sinew_runtime::wire::{Class, encode};

/// Maximum number of lost nodes, causes of refusals, or barriers in one answer.
pub(super) const LISTED_MAX: usize = 64;
/// Maximum number of groups of applications in one answer.
pub(super) const GROUPS_OF_APPS_MAX: usize = 256;
/// Maximum number of names that one application lacks: the maximum that it may require.
pub(super) const MISSING_MAX: usize = 64;

/// An answer with lists, from which entries that do not fit are left out.
pub(super) trait Report {
    /// The class of the answer.
    const TRAVELS: Class = Class::Control;

    /// Drops the second half of a list. Returns whether there was any.
    fn halve(&mut self) -> bool;
}

fn halve<T>(list: &mut Vec<T>, left_out: &mut u64) -> bool {
    let kept = list.len() / 2;
    *left_out += (list.len() - kept) as u64;
    let had_any = !list.is_empty();
    list.truncate(kept);
    had_any
}

/// A list of a report, and the number of further entries that did not fit.
trait Shortened {
    /// Returns the length of the list in the answer, in bytes.
    fn bytes(&self) -> usize;
    /// Drops its second half. Returns whether there was any.
    fn halve(&mut self) -> bool;
}

impl<T: Serialize> Shortened for (&mut Vec<T>, &mut u64) {
    fn bytes(&self) -> usize {
        encode(&self.0).len()
    }

    fn halve(&mut self) -> bool {
        halve(self.0, self.1)
    }
}
