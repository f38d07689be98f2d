//! The known facts about two ends and the path between them.

use std::collections::BTreeMap;

use sinew::{
    AppAddress, NodeAddress, Tid,
    audit::Account,
    inspect::{
        AccessReport, AccessVerdict, AppReport, MismatchReport, Missing, NodeReport, PeerReport,
        StreamReport, TreeLine,
    },
};

use crate::ping;

/// The input of the rules.
#[derive(Clone, Debug, Default)]
pub(super) struct Facts {
    pub(super) ends: [TrafficEnd; 2],
    /// From the node of the first to the second, and back: microseconds until the confirmation, or the failure. `None`:
    /// not tried, for example because the second is known not to be ready.
    pub(super) pings: [Option<Result<u64, String>>; 2],
    /// The counts of the first's node for that of the second after a value of class Stream was sent to it, and back.
    /// `None`: none was sent.
    pub(super) streams: [Option<StreamReport>; 2],
    /// The verdict of the second's node on messages to it from the first, and back. `None`: not two applications, or
    /// the node cannot be asked.
    pub(super) access: [Option<AccessReport>; 2],
    /// The groups for which the verdict of the second's node differs from that on direct messages of the first, and
    /// back; each as written.
    pub(super) by_groups: [Vec<Member>; 2],
    /// The types that one of the two sends and the other handles in another version.
    pub(super) mismatches: Vec<MismatchReport>,
    /// Set if one of the two is many.
    pub(super) many: Option<Many>,
    /// Sockets of this host that accept no connection, with the reason.
    pub(super) shut: Vec<String>,
    /// The applications that wait at a start-up barrier, and their missing requirements, on all asked nodes.
    pub(super) waits: BTreeMap<String, Vec<String>>,
    /// The reports of applications that require one of the two, which no node has listed: the name, the reason, and how
    /// long ago.
    pub(super) lacked: Vec<Missing>,
    /// The names of all known applications and nodes.
    pub(super) names: Vec<String>,
    /// The groups with members on any asked node, and the number of members of each.
    pub(super) groups: BTreeMap<AppAddress, u64>,
    /// The nodes that have not listed all their applications: any of them may have an unlisted one.
    pub(super) unreported: Vec<(String, Unreported)>,
}

/// Why a node has not listed all its applications.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Unreported {
    /// It did not answer, for this reason.
    Silent(String),
    /// This many further ones did not fit into its answer.
    LeftOut(u64),
}

/// A node, or an application on one.
#[derive(Clone, Debug, Default)]
pub(super) struct TrafficEnd {
    /// The word that the user gave.
    pub(super) wanted: String,
    pub(super) node: Option<NodeAddress>,
    /// The report of its node; `None` if it could not be asked.
    pub(super) report: Option<NodeReport>,
    /// Why it could not be asked.
    pub(super) silence: Option<String>,
    /// Other processes with its address.
    pub(super) doubles: Vec<String>,
    /// Set if an application was meant.
    pub(super) app: Option<App>,
    /// Set if several applications have its name.
    pub(super) namesakes: Option<Namesakes>,
}

/// A group, or all applications: a message to it is delivered to each of many.
#[derive(Clone, Debug)]
pub(super) struct Many {
    /// The index of this end.
    pub(super) end: usize,
    pub(super) tid: Tid,
    /// Whether the other end is an application: access lists are about those.
    pub(super) is_judged: bool,
    /// Whether the other end is many, too.
    pub(super) is_sender_many: bool,
    /// The nodes with receivers.
    pub(super) places: Vec<MembersOn>,
    /// The nodes without a report, with the reason.
    pub(super) unreported: Vec<(String, String)>,
}

/// The receivers of a message to many on one node.
#[derive(Clone, Debug)]
pub(super) struct MembersOn {
    pub(super) node: TrafficEnd,
    /// Whether the node has an access list.
    pub(super) is_given: bool,
    pub(super) members: Vec<Member>,
    /// Number of further ones that did not fit into its answer.
    pub(super) left_out: u64,
}

/// One of many, or a path to one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Member {
    /// Its label in the output.
    pub(super) label: String,
    /// The application that it is, or to which the path leads.
    pub(super) app: Tid,
    /// The verdict of its node's access list on each class, if there is a list.
    pub(super) verdicts: Vec<AccessVerdict>,
}

/// Several applications with one name.
#[derive(Clone, Debug)]
pub(super) struct Namesakes {
    /// The checked one.
    pub(super) tid: Tid,
    /// The node from which messages to the name reach that one.
    pub(super) seen_from: String,
    /// The others.
    pub(super) others: Vec<Tid>,
}

/// An application.
#[derive(Clone, Debug, Default)]
pub(super) struct App {
    /// The report of its node; `None` if the node has not listed it.
    pub(super) report: Option<AppReport>,
    /// Why it may exist although its node has not listed it.
    pub(super) unreported: Option<Unreported>,
    /// Its line in the supervision tree, if it is supervised there.
    pub(super) line: Option<TreeLine>,
    /// Number of refused messages for it so far.
    pub(super) refused: u64,
    /// What it has sent on direct links, by the addresses of the receivers.
    pub(super) direct: Vec<(AppAddress, Account)>,
}

impl TrafficEnd {
    /// Returns its label in the output.
    pub(super) fn label(&self) -> &str {
        &self.wanted
    }

    /// Returns the label of the node.
    pub(super) fn node_label(&self) -> &str {
        self.report.as_ref().map_or(&self.wanted, |report| &report.name)
    }

    /// Returns the address of its application, if its node has listed it.
    pub(super) fn app_tid(&self) -> Option<Tid> {
        self.app.as_ref()?.report.as_ref().map(|report| report.tid)
    }

    /// Returns why its application accepts no messages yet, if its node reports that.
    pub(super) fn not_ready(&self) -> Option<String> {
        ping::unready(self.app.as_ref()?.report.as_ref()?)
    }

    /// Returns the report of its node about another one.
    pub(super) fn peer(&self, node: NodeAddress) -> Option<&PeerReport> {
        self.report.as_ref()?.peers.iter().find(|peer| peer.node == node)
    }
}
