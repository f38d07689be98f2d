//! The state that all layers of one node share.

use std::{
    net::{SocketAddr, SocketAddrV4},
    sync::{
        Arc, OnceLock,
        atomic::{AtomicBool, Ordering},
    },
};

#[cfg(any(test, feature = "testing"))]
use sinew_runtime::event_queue::EventQueue;
use sinew_runtime::{
    outcome::Rejection,
    router::Router,
    tid::{Incarnation, NodeAddress},
    wire::Message,
};
use tokio::sync::watch;

#[cfg(any(test, feature = "testing"))]
use crate::limits::EVENT_QUEUE_CAPACITY;
use crate::{
    app_backlog::AppBacklogs,
    clocks::ClockOffsets,
    config::NodeConfig,
    events::{EventQueues, LayerReport, Root},
    leave_reason::LeaveReason,
    log_quotas::LogQuotas,
    periodic_checks::PeriodicChecks,
    ports::Ports,
    refusals::Refusals,
    room_notifier::RoomNotifier,
};

/// The state that all layers of one node share. It outlives every layer: the root owns it, and passes it to
/// each new instance of a layer.
pub struct NodeContext {
    /// The node's configuration, validated.
    pub config: NodeConfig,
    /// The node's address.
    pub node: NodeAddress,
    /// The incarnation of this node.
    pub incarnation: Incarnation,
    /// Set by the root once all layers have been ready. If a layer fails before then, the node's start fails.
    pub has_started: AtomicBool,
    /// Set by the root before it stops the layers. A layer sends GOODBYE to others only if this is set, not
    /// when the layer alone is restarted.
    pub stopping: AtomicBool,
    /// Why the node gave up. Peers receive this reason instead of an orderly GOODBYE. Set before `stopping`.
    pub gave_up: OnceLock<LeaveReason>,
    /// Routes messages to applications, groups and other nodes.
    pub router: Arc<Router>,
    /// The event queues of the layers.
    pub event_queues: EventQueues,
    /// The root of the node.
    pub root: Arc<dyn Root>,
    /// The traits by which layers call each other.
    pub ports: Ports,
    /// The clock offset of each peer relative to this node. NDL writes it and GNCL reads it.
    pub clocks: ClockOffsets,
    /// The addresses at which GNCL listens. NDL announces them.
    pub listens: Listens,
    /// Counts of the inputs that LNCL, the sync manager and NDL's sockets refused.
    pub refusals: Arc<Refusals>,
    /// Facts about this node's applications that are pending because the event queues of their readers were full.
    pub app_backlogs: AppBacklogs,
    /// Notifies the layers that an application with a full mailbox has room again.
    pub room_notifier: Arc<RoomNotifier>,
    /// Counts the changes of the directory of names, on this node or any other.
    pub directory_changes: watch::Sender<u64>,
    /// Set from the notification of the sync manager about changed groups until the sync manager reads the groups.
    groups_notified: AtomicBool,
    /// Limits the log lines that other nodes and clients can cause.
    pub log_quotas: LogQuotas,
    /// LNCL's checks for all that is due later. Any thread that adds such an item requests them.
    pub checks: Arc<PeriodicChecks>,
    /// Points at which tests inject faults.
    #[cfg(feature = "fault-points")]
    pub faults: sinew_runtime::supervision::fault::FaultPoints,
}

/// The addresses at which GNCL listens, set once it does. A restarted GNCL keeps the same listeners.
#[derive(Debug, Default)]
pub struct Listens {
    /// The first address.
    pub first: OnceLock<SocketAddr>,
    /// The further addresses; set together with the first one.
    pub further: OnceLock<Vec<SocketAddrV4>>,
    /// The TCP port at this host's IPv6 addresses, if GNCL listens there; set together with the first address.
    pub port6: OnceLock<u16>,
}

impl NodeContext {
    /// Creates the shared state of a node that has not started yet. The node's address is that of `config`.
    #[must_use]
    pub fn new(config: NodeConfig, incarnation: Incarnation, root: Arc<dyn Root>) -> Arc<Self> {
        let (node, checks) = (config.node_address(), Arc::<PeriodicChecks>::default());
        let router = Router::new(node);
        if config.contracts.dry_run {
            router.run_dry();
        }
        Arc::new(Self {
            node,
            incarnation,
            has_started: AtomicBool::new(false),
            stopping: AtomicBool::new(false),
            gave_up: OnceLock::new(),
            router: Arc::new(router),
            event_queues: EventQueues::default(),
            root,
            ports: Ports::default(),
            clocks: ClockOffsets::default(),
            listens: Listens::default(),
            refusals: Arc::default(),
            app_backlogs: AppBacklogs::new(config.lncl.apps_max),
            room_notifier: Arc::default(),
            directory_changes: watch::Sender::default(),
            groups_notified: AtomicBool::new(false),
            log_quotas: LogQuotas::new(&checks),
            checks,
            config,
            #[cfg(feature = "fault-points")]
            faults: sinew_runtime::supervision::fault::FaultPoints::default(),
        })
    }

    /// Returns a context without a node, and the queue of its root's reports, for tests.
    #[cfg(any(test, feature = "testing"))]
    #[must_use]
    pub fn for_test(config: NodeConfig, incarnation: Incarnation) -> (Arc<Self>, EventQueue<LayerReport>) {
        let root = EventQueue::new(EVENT_QUEUE_CAPACITY);
        (Self::new(config, incarnation, Arc::new(root.clone())), root)
    }

    /// Offers an event or an answer of a layer to an application of this node. After `QueueFull`,
    /// [`room_notifier`](Self::room_notifier) is notified as soon as the mailbox has room.
    ///
    /// # Errors
    /// The reason of the rejection.
    pub fn offer_event(&self, event: Message) -> Result<(), Rejection> {
        let room = self.room_notifier.event_waker();
        let Err(refused) = self.router.offer(event, Some(&room)) else { return Ok(()) };
        let why = refused.why;
        if why != Rejection::QueueFull {
            self.router.refuse(refused);
        }
        Err(why)
    }

    /// Reports that the system refuses a resource that a layer needs: a port, a thread, a descriptor.
    ///
    /// While the node starts, the start fails with this text, once. Later this instance of the layer fails, and
    /// its supervisor tries again: a port may become free.
    ///
    /// # Panics
    /// With this text once the node has started, or if the root takes no report.
    pub fn cannot_start(&self, reason: String) {
        let is_first = !self.has_started.load(Ordering::Acquire);
        if is_first && self.root.report(LayerReport::CannotStart(reason.clone())).is_ok() {
            // Never ready: the root stops it.
            return;
        }
        panic!("{reason}");
    }

    /// Records that groups have changed and returns whether the sync manager must be notified. The sync
    /// manager reads all groups, so one notification covers all changes until then. A client that joins and
    /// leaves in a loop therefore cannot fill its event queue.
    pub fn groups_need_notification(&self) -> bool {
        !self.groups_notified.swap(true, Ordering::AcqRel)
    }

    /// Records that the sync manager is about to read the groups: the next change causes a notification again.
    pub fn mark_groups_read(&self) {
        // A swap, not a store: a change made before a suppressed notification must be visible to the thread
        // that reads the groups now.
        self.groups_notified.swap(false, Ordering::AcqRel);
    }

    /// Records that an application on this or another node got a name or lost it. Called after the change,
    /// and before the application that caused it receives the confirmation.
    pub fn directory_has_changed(&self) {
        self.directory_changes.send_modify(|count| *count += 1);
    }
}
