//! Requests to a host and their answers: one line of JSON each, over the standard streams of `sinew host`.
//!
//! The content of a file follows its request as it is. The same program is at both ends, as the caller has copied it.

use serde::{Deserialize, Serialize};

use super::order::{Hash, NodeOrder};

/// Longest line in bytes.
pub(super) const LINE_BYTES_MAX: u64 = 16 << 20;
/// Longest file in bytes.
pub(super) const CONTENT_BYTES_MAX: u64 = 4 << 30;
/// Longest part of a log in an answer, in bytes.
pub(super) const LOG_BYTES_MAX: u64 = 1 << 20;

/// A request to a host.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum Request {
    /// The first one.
    Enter {
        robot: String,
        /// Absolute path of the folder of all robots; `None`: below the home directory.
        folder: Option<String>,
        /// Whether the caller changes something: only one at a time may.
        changes: bool,
    },
    /// Reports the nodes that have files here. With `asks` their applications, too.
    Observe { asks: bool },
    /// Returns which of these contents the host lacks.
    Missing(Vec<Hash>),
    /// Stores a content of this length, which follows.
    Put { hash: Hash, bytes: u64 },
    /// Checks that the ports and the socket of a node are free.
    Check(NodeOrder),
    /// Places the files of a node, and starts it.
    Start(NodeOrder),
    /// Places the files of a node, and writes this unit of systemd for it.
    WriteUnit { order: NodeOrder, unit: String },
    /// Writes the target of all units.
    WriteTarget(String),
    /// Ends a node by SIGTERM, and by SIGKILL after so long.
    Stop { node: String, within_ms: u64 },
    /// Removes the files of a node that does not run.
    Remove { node: String },
    /// Removes contents that no node needs, and empty folders.
    Sweep,
    /// Returns the end of a node's log, of at most so many bytes.
    Log { node: String, bytes_max: u64 },
}

/// The answer to a request.
#[derive(Debug, Serialize, Deserialize)]
pub(super) enum Answer {
    /// The folder of the robot on this host.
    Entered {
        folder: String,
    },
    Nodes(Vec<NodeSeen>),
    Missing(Vec<Hash>),
    /// Done, with a note for users.
    Done(String),
    Log(String),
    /// Not done: the cause, the place and the remedy.
    Refused(String),
}

/// A node as its host sees it.
#[derive(Clone, Debug, Serialize, Deserialize)]
pub(super) struct NodeSeen {
    pub(super) order: NodeOrder,
    /// `None`: it does not run.
    pub(super) process: Option<ProcessSeen>,
    /// The last lines of its log, if it does not run.
    pub(super) last_lines: String,
    /// Its applications, if it was asked.
    pub(super) apps: Apps,
}

/// A running process.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct ProcessSeen {
    pub(super) pid: i32,
    /// Since when it runs, in seconds of the host's uptime before now.
    pub(super) up_s: u64,
}

/// The applications of a node.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) enum Apps {
    /// It has no client socket, or was not asked.
    NotAsked,
    /// It gave no answer, for this reason.
    Silent(String),
    /// The named ones.
    Listed(Vec<AppSeen>),
}

/// An application of a node.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub(super) struct AppSeen {
    pub(super) name: String,
    pub(super) is_ready: bool,
    /// Why it is not ready, as text.
    pub(super) why: String,
}
