//! The reasons why a declared node does not run.

use std::{fmt, path::PathBuf, time::Duration};

use sinew_model::{config::ConfigError, directory::Waiting};
use sinew_runtime::{
    name::NameError,
    remedy::{Wanted, remedy},
};
use sinew_security::node_security::KeyError;

use crate::tree::Supervised;

/// Why a node does not run.
///
/// # Examples
///
/// ```no_run
/// use sinew::prelude::*;
///
/// match Node::from_file("/etc/sinew/knee.toml").start() {
///     Ok(node) => println!("the node has the address {}", node.address()),
///     Err(StartError::Config(faults)) => {
///         // All of them at once: an editor can jump to each line.
///         faults.faults().iter().for_each(|fault| eprintln!("{:?}: {fault}", fault.line));
///     }
///     Err(StartError::AddressTaken(words)) => eprintln!("is this node started twice? {words}"),
///     Err(other) => eprintln!("{other}"),
/// }
/// ```
#[derive(thiserror::Error)]
pub enum StartError {
    /// The configuration has faults; all of them are listed.
    #[error(transparent)]
    Config(#[from] ConfigError),
    /// Two children of the node have the same name.
    #[error("two applications or supervisors of this node are called '{0}'; names are unique on a node")]
    SameName(String),
    /// The name of a child of the node breaks the grammar of [names](sinew_runtime::name).
    #[error("the application or supervisor '{name}' cannot have this name: {why}")]
    BadName {
        /// The name, its odd characters escaped.
        name: String,
        /// The rule that it breaks.
        why: NameError,
    },
    /// An application could not be registered.
    #[error("application '{name}' cannot be registered: {why}")]
    Application {
        /// The name of the application.
        name: String,
        /// The cause.
        why: String,
    },
    /// `lncl.socket` cannot be opened: another node has it, or the directory is not writable. No layer was started.
    #[error("the socket for applications of other processes cannot be opened: {0}")]
    Socket(String),
    /// The configuration turns security on, and the node's keys cannot be used. Nothing was started.
    #[error("security.keys is set, and the node does not start without them:\n{0}")]
    Keys(#[from] KeyError),
    /// The configuration names an access list, and it cannot be used. Nothing was started.
    #[error("security.access is set, and the node does not start without the list in {path:?}:\n{faults}")]
    Access {
        /// The file.
        path: PathBuf,
        /// All faults of the list.
        faults: ConfigError,
    },
    /// `record.folder` or `record.file` is set, and the recording cannot begin.
    #[error("the section record asks for a recording, and the node does not start without it: {0}")]
    Record(String),
    /// `sinew play --check` may run, and has not started this process. Nothing was started.
    #[error("{0}")]
    Check(String),
    /// A layer did not become ready.
    #[error("the layers did not start: {0}")]
    Layers(String),
    /// Another living process has the node's address: the text names it. There is no retry.
    #[error("{0}")]
    AddressTaken(String),
    /// Applications require each other in a circle: none of them can start first.
    ///
    /// The first name is repeated at the end; an application of another node has its node's name.
    #[error("these applications require each other in a circle, so that none of them can start: {}; take one of these requirements out", .0.join(" requires "))]
    Cycle(Vec<String>),
    /// Applications wait for each other in a circle, some because their supervisor starts them in order.
    #[error("these applications wait for each other in a circle, by the order of their start and by what they require: {}; change the order, or take a requirement out", .0.join(" -> "))]
    OrderCycle(Vec<String>),
    /// A child is significant and permanent.
    #[error("'{0}' is significant, but permanent: it never ends for good; make it transient or temporary")]
    PermanentSignificant(String),
    /// A child is significant for a supervisor that does not end with it.
    #[error(
        "'{child}' is significant, but its supervisor '{supervisor}' never ends with its children; set `auto_shutdown`"
    )]
    SignificantForNobody {
        /// The child.
        child: String,
        /// Its supervisor.
        supervisor: String,
    },
    /// Applications are not ready: they wait for their requirements, or their starts fail. The node runs.
    #[error("after {within:?} these are not ready:{}{}", list(.waiting), list(.starting))]
    Waiting {
        /// The applications that wait for others, and the applications that each waits for.
        waiting: Vec<Waiting>,
        /// The applications of this process with all requirements met: they start, or are tried again after a
        /// failed start.
        starting: Vec<Supervised>,
        /// The time limit.
        within: Duration,
    },
    /// The node ends, or has ended.
    #[error("the node is ending or has ended; `Node::wait_for_end` returns the reason")]
    Ended,
    /// The root's order queue is full. The request was not queued.
    #[error("the node's root has more orders waiting than it can keep; ask again, and not so often")]
    Busy,
    /// An injected fault is invalid.
    #[cfg(feature = "fault-points")]
    #[error(transparent)]
    Fault(#[from] sinew_runtime::supervision::fault::FaultError),
    /// The program was built with `panic = "abort"`: its first panic ends the process, and supervisors cannot
    /// help.
    #[error(
        "this program ends with its first panic, and no supervisor can help: take `panic = \"abort\"` out of its Cargo \
         profile, or say `accept_abort_on_panic()` where that is what you want"
    )]
    AbortsOnPanic,
    /// An application needs a process of its own, and the system cannot monitor one: the text names the
    /// missing feature. Nothing was started.
    #[error("{0}")]
    OwnProcess(String),
    /// The operating system provides no thread.
    #[error("no thread for the node's root: {0}; {remedy}", remedy = remedy(Wanted::Thread, .0))]
    Thread(#[from] std::io::Error),
}

/// The same text as `Display`: a program that returns this error from `main` displays only this.
impl fmt::Debug for StartError {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        fmt::Display::fmt(self, f)
    }
}

fn list(applications: &[impl fmt::Display]) -> String {
    applications.iter().map(|application| format!("\n  {application}")).collect()
}
