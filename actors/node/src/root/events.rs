//! The events of the root.

use std::sync::mpsc::SyncSender;

use sinew_model::events::{LayerReport, Root};

use sinew_runtime::{event_queue::EventQueue, supervision::SupervisorFact};

use crate::{commands::Ordered, reply_waiters::ReplySender, tree::SupervisionTree};

/// An event of the root.
#[derive(Debug)]
pub(crate) enum RootEvent {
    /// By a layer.
    Layer(LayerReport),
    /// By the layers' supervisor.
    Layers(SupervisorFact),
    /// By the applications' supervisor.
    Apps(SupervisorFact),
    /// By the owner: stop on SIGINT and SIGTERM.
    HeedSignals,
    /// By [`Node::run`](crate::Node::run): only the node itself handles its end.
    RunsAlone,
    /// By the owner or a signal.
    StopOrdered,
    /// By the node's drop in a thread that panics.
    OwnerPanicked,
    /// By the owner: add, stop, start again or remove a child.
    Ordered(Ordered),
    /// By the owner: return the supervision tree.
    QueryTree(SyncSender<SupervisionTree>),
    /// By a test: panic.
    #[cfg(feature = "fault-points")]
    Fail,
    /// By a test: let the applications' supervisor panic.
    #[cfg(feature = "fault-points")]
    FailSupervisor,
    /// By the owner: report when every application runs.
    NotifyWhenRunning(ReplySender),
}

/// The queue of the root, as the layers see it.
pub(crate) struct RootQueue(pub(crate) EventQueue<RootEvent>);

impl Root for RootQueue {
    fn report(&self, report: LayerReport) -> Result<(), LayerReport> {
        let Err(event) = self.0.post(RootEvent::Layer(report)) else { return Ok(()) };
        let RootEvent::Layer(report) = event else {
            unreachable!("the queue returns the event that it rejected")
        };
        Err(report)
    }

    fn has_ended(&self) -> bool {
        self.0.is_closed()
    }
}
