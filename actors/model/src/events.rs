//! The events of the layers: each layer has one queue of them, to which any thread may add.

use std::{future::poll_fn, net::SocketAddr, task::Poll};

use sinew_runtime::{
    event_queue::EventQueue,
    tid::{AppAddress, Incarnation, NodeAddress},
    wire::Message,
};
use tokio::sync::{Notify, oneshot};

use crate::{
    facts::{AppFact, LinkFact, MembershipFact},
    limits::EVENT_QUEUE_CAPACITY,
    progress::Progress,
};

/// The events of LNCL's actor.
#[derive(Debug)]
#[expect(missing_docs, reason = "each field is what its name says")]
pub enum LnclEvent {
    /// From the root: all applications that this client requires are ready.
    Released { app: AppAddress },
    /// From any thread: rejected messages must be reported to their senders.
    Undelivered,
}

/// An event for GNCL.
#[derive(Clone, Debug)]
#[expect(missing_docs, reason = "each field is what its name says")]
pub enum GnclEvent {
    /// From NDL: a change of membership.
    Membership(MembershipFact),
    /// From NDL: this incarnation of a node listens at these addresses now.
    Moved { node: NodeAddress, incarnation: Incarnation, gncl: Vec<SocketAddr> },
    /// From NDL: this incarnation of a node does not block another one any more.
    Forgotten { node: NodeAddress, incarnation: Incarnation },
    /// From the reload of the deny list: another list is in force.
    DenyListChanged,
}

/// An event for NDL.
#[derive(Clone, Debug)]
pub enum NdlEvent {
    /// From GNCL: a connection was made, broke, or cannot be restored.
    Link(LinkFact),
    /// From LNCL: an application that handles [`NodeEvent`](crate::facts::NodeEvent) became ready, failed or ended.
    App(AppFact),
}

/// An event for the sync manager.
#[derive(Debug)]
pub enum SyncEvent {
    /// From LNCL: an application registered, became ready, failed, or unregistered.
    App(AppFact),
    /// From NDL: a change of the known nodes.
    Membership(MembershipFact),
    /// From GNCL: a change of the reachable nodes.
    Link(LinkFact),
    /// From a change of a monitor or of a monitored application: outputs are pending, or a timer must be set.
    Monitors,
    /// From another node: a message for the sync manager's TID.
    Message(Message),
}

impl SyncEvent {
    /// Returns a copy of the event. The copy of a message has no receipt, because a receipt is never shared.
    #[must_use]
    pub fn copy(&self) -> Self {
        match self {
            Self::App(fact) => Self::App(fact.clone()),
            Self::Membership(fact) => Self::Membership(fact.clone()),
            Self::Link(fact) => Self::Link(fact.clone()),
            Self::Monitors => Self::Monitors,
            Self::Message(message) => Self::Message(Message::new(message.header, message.payload.clone())),
        }
    }
}

/// A report of a layer to the root of its node.
#[derive(Debug)]
#[expect(missing_docs, reason = "each field is what its name says")]
pub enum LayerReport {
    /// By the sync manager: all requirements of this application are ready.
    Release { app: AppAddress },
    /// By the sync manager: these names require each other in a circle, the first one repeated at the end.
    /// None of these applications is released.
    RequirementCycle {
        names: Vec<String>,
        /// The same with the names of other nodes.
        labels: Vec<String>,
    },
    /// By NDL: another living process has the node's address; text for the program that started the node. The
    /// node ends.
    AddressTaken(String),
    /// By a layer: the system refuses a resource that the layer needs; text for the program that starts the
    /// node. The start fails.
    CannotStart(String),
    /// By NDL: return the layers, applications and clients in trouble.
    RequestProgress(oneshot::Sender<Progress>),
}

/// The root of a node, as the layers see it.
pub trait Root: Send + Sync {
    /// Reports to the root.
    ///
    /// # Errors
    /// Returns the report if the root's queue is full, or if the root has ended.
    fn report(&self, report: LayerReport) -> Result<(), LayerReport>;

    /// Returns whether the root has ended.
    fn has_ended(&self) -> bool;
}

/// A queue of reports, for tests that take the place of the root.
impl Root for EventQueue<LayerReport> {
    fn report(&self, report: LayerReport) -> Result<(), LayerReport> {
        self.post(report)
    }

    fn has_ended(&self) -> bool {
        self.is_closed()
    }
}

/// The layers with an event queue that had no room for all pending events.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
#[expect(missing_docs, reason = "each field is the queue of the layer of its name")]
pub struct FullQueues {
    pub gncl: bool,
    pub ndl: bool,
    pub sync: bool,
}

impl FullQueues {
    /// Returns the name of one of the layers; `None` if no queue was full.
    #[must_use]
    pub const fn layer(self) -> Option<&'static str> {
        match self {
            Self { gncl: true, .. } => Some("GNCL"),
            Self { ndl: true, .. } => Some("NDL"),
            Self { sync: true, .. } => Some("the sync manager"),
            Self { .. } => None,
        }
    }

    /// Waits until one of these queues has room.
    pub async fn room(self, event_queues: &EventQueues) {
        poll_fn(|cx| {
            let has_room = [
                self.gncl && event_queues.gncl.poll_room(cx).is_ready(),
                self.ndl && event_queues.ndl.poll_room(cx).is_ready(),
                self.sync && event_queues.sync.poll_room(cx).is_ready(),
            ];
            if has_room.contains(&true) { Poll::Ready(()) } else { Poll::Pending }
        })
        .await;
    }
}

/// Calls `offer` when a producer found a queue full, which `has_pending` notifies, and when one of the full
/// queues has room again. It runs for as long as its layer.
pub async fn offer_when_room(
    event_queues: &EventQueues,
    has_pending: &Notify,
    mut offer: impl FnMut() -> FullQueues,
) {
    loop {
        // A former instance may have left pending events, too.
        let full = offer();
        tokio::select! {
            () = has_pending.notified() => {}
            () = full.room(event_queues) => {}
        }
    }
}

/// The event queues of the layers.
#[derive(Debug)]
#[expect(missing_docs, reason = "each field is the queue of the layer of its name")]
pub struct EventQueues {
    pub lncl: EventQueue<LnclEvent>,
    pub sync: EventQueue<SyncEvent>,
    pub gncl: EventQueue<GnclEvent>,
    pub ndl: EventQueue<NdlEvent>,
}

impl Default for EventQueues {
    fn default() -> Self {
        Self {
            lncl: EventQueue::new(EVENT_QUEUE_CAPACITY),
            sync: EventQueue::new(EVENT_QUEUE_CAPACITY),
            gncl: EventQueue::new(EVENT_QUEUE_CAPACITY),
            ndl: EventQueue::new(EVENT_QUEUE_CAPACITY),
        }
    }
}
