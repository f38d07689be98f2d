//! The answers of all nodes at one moment.

use std::{collections::BTreeSet, time::Duration};

use sinew::{
    NodeAddress, Tid, Time,
    audit::NodeAudit,
    inspect::{AppsReport, LogLine, NodeReport, TreeReport},
};

/// Maximum number of nodes that are asked for one snapshot. Further ones are counted.
pub const NODES_MAX: usize = 128;

/// The answers of all nodes at one moment.
#[derive(Clone, Debug)]
pub struct Snapshot {
    /// When the first question was asked.
    pub taken: Time,
    /// Time from the first question to the last answer.
    pub took: Duration,
    /// The report of the entry node about itself and the nodes that it knows, or why there is none.
    pub entry: Result<NodeReport, String>,
    /// The answers of each node that was asked, the entry node among them.
    pub nodes: Vec<NodeAnswers>,
    /// Number of known nodes that were not asked, because of [`NODES_MAX`].
    pub left_out: u64,
    /// The addresses of this program, which are no part of the system.
    pub own: BTreeSet<Tid>,
}

/// The answers of one node.
#[derive(Clone, Debug)]
pub struct NodeAnswers {
    /// Its address.
    pub node: NodeAddress,
    /// Its name, as the entry node reports it; may be empty.
    pub name: String,
    /// Its answers, or why they are missing.
    pub result: Result<Box<Answers>, String>,
}

/// The reports of one node about itself.
#[derive(Clone, Debug)]
pub struct Answers {
    /// Its state, and the nodes that it knows.
    pub node: NodeReport,
    /// Its applications and barriers.
    pub apps: AppsReport,
    /// Its supervision tree.
    pub tree: TreeReport,
    /// The counters of its messages.
    pub audit: NodeAudit,
    /// The newest warnings and errors of its log, oldest first. Former snapshots may have some of them.
    pub log: Vec<LogLine>,
}

impl Snapshot {
    /// Returns the snapshot of a system without an answer of its entry node.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::Time;
    /// use sinew_view::Snapshot;
    ///
    /// let snapshot = Snapshot::without_entry(Time::now(), "it was stopped".to_owned());
    /// assert!(snapshot.nodes.is_empty());
    /// ```
    #[must_use]
    pub const fn without_entry(taken: Time, why: String) -> Self {
        Self {
            taken,
            took: Duration::ZERO,
            entry: Err(why),
            nodes: Vec::new(),
            left_out: 0,
            own: BTreeSet::new(),
        }
    }

    /// Returns the answers of each node that has answered.
    pub(crate) fn answers(&self) -> impl Iterator<Item = &Answers> {
        self.nodes.iter().filter_map(|node| node.result.as_deref().ok())
    }
}
