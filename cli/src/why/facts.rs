//! What is known of two ends and of the way between them.

use std::collections::BTreeMap;

use sinew::{
    NodeAddress, Tid,
    inspect::{
        AccessReport, AccessVerdict, AppReport, Missing, NodeReport, PeerReport, StreamReport, TreeLine,
    },
};

use crate::ping;

/// All that the rules look at.
#[derive(Clone, Debug, Default)]
pub(super) struct Facts {
    pub(super) ends: [End; 2],
    /// From the node of the first to the second, and back: microseconds until it was confirmed, or why not. `None`: not tried, as
    /// where the second is known not to be ready.
    pub(super) pings: [Option<Result<u64, String>>; 2],
    /// What the node of the first has counted for that of the second when a value of class Stream had been sent to it, and back. `None`: none
    /// was sent.
    pub(super) streams: [Option<StreamReport>; 2],
    /// What the node of the second says of messages to it from the first, and back. `None`: not two applications, or it cannot be asked.
    pub(super) access: [Option<AccessReport>; 2],
    /// The groups by which the first reaches the second otherwise than by itself, as the list of the second's node says, and back; each as it
    /// is written.
    pub(super) by_groups: [Vec<Member>; 2],
    /// If one of the two is many.
    pub(super) many: Option<Many>,
    /// Sockets of this host that let nobody in, with the reason.
    pub(super) shut: Vec<String>,
    /// Who waits at a start-up barrier, and for whom, on all nodes that were asked.
    pub(super) waits: BTreeMap<String, Vec<String>>,
    /// What applications that require one of the two, which no node has named, say of it: the name, the reason, and how long ago.
    pub(super) lacked: Vec<Missing>,
    /// The nodes that have not named all their applications: any of them may have one that nobody named.
    pub(super) unsaid: Vec<(String, Unsaid)>,
}

/// Why a node has not named all its applications.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) enum Unsaid {
    /// It did not answer, for this reason.
    Silent(String),
    /// So many further ones had no room in its answer.
    LeftOut(u64),
}

/// A node, or an application on one.
#[derive(Clone, Debug, Default)]
pub(super) struct End {
    /// As the user called it.
    pub(super) wanted: String,
    pub(super) node: Option<NodeAddress>,
    /// What its node says; `None` if it could not be asked.
    pub(super) report: Option<NodeReport>,
    /// Why it could not.
    pub(super) silence: Option<String>,
    /// Other processes with its address.
    pub(super) doubles: Vec<String>,
    /// If an application was meant.
    pub(super) app: Option<App>,
    /// If several have its name.
    pub(super) namesakes: Option<Namesakes>,
}

/// A group, or everybody: what is sent to it goes to each of many.
#[derive(Clone, Debug)]
pub(super) struct Many {
    /// Which of the two ends it is.
    pub(super) end: usize,
    pub(super) tid: Tid,
    /// Whether the other end is an application: access lists are about those.
    pub(super) is_judged: bool,
    /// Whether the other end is many, too.
    pub(super) is_sender_many: bool,
    /// The nodes where somebody gets it.
    pub(super) places: Vec<MembersOn>,
    /// The nodes that did not say, with the reason.
    pub(super) unsaid: Vec<(String, String)>,
}

/// Those on one node that get what is sent to many.
#[derive(Clone, Debug)]
pub(super) struct MembersOn {
    pub(super) node: End,
    /// Whether the node has an access list.
    pub(super) is_given: bool,
    pub(super) members: Vec<Member>,
    /// Further ones that had no room in its answer.
    pub(super) left_out: u64,
}

/// One of many, or a way to one.
#[derive(Clone, Debug, PartialEq, Eq)]
pub(super) struct Member {
    /// As it is called in what is said.
    pub(super) label: String,
    /// What the access list of its node says of each class, if there is one.
    pub(super) verdicts: Vec<AccessVerdict>,
}

/// Several applications with one name.
#[derive(Clone, Debug)]
pub(super) struct Namesakes {
    /// The one that is looked at.
    pub(super) tid: Tid,
    /// The node whose messages to the name reach that one.
    pub(super) seen_from: String,
    /// The others.
    pub(super) others: Vec<Tid>,
}

/// An application.
#[derive(Clone, Debug, Default)]
pub(super) struct App {
    /// What its node says of it; `None` if it has not named it.
    pub(super) report: Option<AppReport>,
    /// Why it may be there though its node has not named it.
    pub(super) unsaid: Option<Unsaid>,
    /// Its line in the supervision tree, if it is supervised there.
    pub(super) line: Option<TreeLine>,
    /// Messages for it that were refused so far.
    pub(super) refused: u64,
}

impl End {
    /// As it is called in what is said.
    pub(super) fn label(&self) -> &str {
        &self.wanted
    }

    /// The node, as it is called.
    pub(super) fn node_label(&self) -> &str {
        self.report.as_ref().map_or(&self.wanted, |report| &report.name)
    }

    /// Why its application takes no messages yet, if its node says so.
    pub(super) fn not_ready(&self) -> Option<String> {
        ping::unready(self.app.as_ref()?.report.as_ref()?)
    }

    /// What its node says of another one.
    pub(super) fn peer(&self, node: NodeAddress) -> Option<&PeerReport> {
        self.report.as_ref()?.peers.iter().find(|peer| peer.node == node)
    }
}
