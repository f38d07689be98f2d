//! What the root is told.

use std::sync::mpsc::SyncSender;

use sinew_runtime::{supervision::SupervisorFact, tid::AppAddress};
use tokio::sync::oneshot;

use crate::{
    ndl,
    node::{asker::Asker, commands::Ordered, tree::SupervisionTree},
};

/// What the root is told.
#[derive(Debug)]
pub(crate) enum RootEvent {
    /// By the sync manager: all that this application requires is ready.
    Release { app: AppAddress },
    /// By the sync manager: these names require each other in a circle, the first one again at the end. None of these
    /// applications is released.
    RequirementCycle {
        names: Vec<String>,
        /// The same with the names of other nodes.
        labels: Vec<String>,
    },
    /// By the layers' supervisor.
    Layers(SupervisorFact),
    /// By the applications' supervisor.
    Apps(SupervisorFact),
    /// By the owner: stop on SIGINT and SIGTERM.
    HeedSignals,
    /// By [`Node::run`](crate::Node::run): nobody but the node itself handles an end.
    RunsAlone,
    /// By the owner or a signal.
    StopOrdered,
    /// By the node's drop in a thread that panics.
    OwnerPanicked,
    /// By the owner: add, stop, start again or remove a child.
    Ordered(Ordered),
    /// By the owner: say who is supervised.
    TellTree(SyncSender<SupervisionTree>),
    /// By NDL: another living process has the node's address, in words for who started the node. The node ends.
    AddressTaken(String),
    /// By NDL: say what does not get on.
    TellProgress(oneshot::Sender<ndl::Progress>),
    /// By a test: panic.
    #[cfg(feature = "fault-points")]
    Fail,
    /// By a test: let the applications' supervisor panic.
    #[cfg(feature = "fault-points")]
    FailSupervisor,
    /// By the owner: say when every application runs.
    TellWhenRunning(Asker),
}
