//! The state of a node: what all layers share, and the state of each layer. It outlives every layer.

use std::sync::Arc;

use sinew_model::{config::NodeConfig, context::NodeContext, limits::EVENT_QUEUE_CAPACITY};
use sinew_runtime::{
    event_queue::EventQueue,
    lock,
    tid::{AppAddress, Incarnation},
};
use sinew_security::SecurityState;

use super::inspect::Contracts;
use super::log_ring::LogRing;
use super::real_time::RealTime;
use super::recording::{Recording, Triggers};
use super::root::{RootEvent, RootQueue};
use crate::{
    audit,
    types::{self, Types},
};

/// The state of a node. The root owns it, and lends its parts to each new instance of a layer.
pub(crate) struct NodeState {
    /// What all layers share.
    pub(crate) ctx: Arc<NodeContext>,
    /// The security in force.
    pub(crate) security: Arc<SecurityState>,
    /// The events of the root.
    pub(crate) root: EventQueue<RootEvent>,
    /// The state of LNCL.
    pub(crate) lncl: Arc<sinew_lncl::State>,
    /// The state of GNCL.
    pub(crate) gncl: Arc<sinew_gncl::State>,
    /// The state of NDL.
    pub(crate) ndl: Arc<sinew_ndl::State>,
    /// The state of the sync manager.
    pub(crate) sync: Arc<sinew_sync::State>,
    /// The audit questions that this node has sent, and those that it has received.
    pub(crate) questions: audit::Questions,
    /// The payload types of its applications, and the comparison with those of other nodes.
    pub(crate) types: Types,
    /// The recording of its messages.
    pub(crate) recording: Recording,
    /// The proof of real time.
    pub(crate) real_time: Arc<RealTime>,
    /// The contracts of its applications.
    pub(crate) contracts: Contracts,
    /// The newest lines of the log.
    pub(crate) log: Arc<LogRing>,
}

impl NodeState {
    /// Returns the state of a node that has not started yet, its layers connected.
    pub(crate) fn new(config: NodeConfig, incarnation: Incarnation) -> Arc<Self> {
        let root = EventQueue::new(EVENT_QUEUE_CAPACITY);
        let ctx = NodeContext::new(config, incarnation, Arc::new(RootQueue(root.clone())));
        let security = Arc::new(SecurityState::default());
        let lncl = sinew_lncl::State::new(ctx.clone(), security.clone());
        let gncl = sinew_gncl::State::new(ctx.clone(), security.clone());
        let ndl = sinew_ndl::State::new(ctx.clone(), security.clone());
        let sync = sinew_sync::State::new(ctx.clone(), security.clone());
        let state = Arc::new(Self {
            ctx,
            security,
            root,
            lncl,
            gncl,
            ndl,
            sync,
            questions: audit::Questions::default(),
            types: Types::default(),
            recording: Recording::default(),
            real_time: Arc::default(),
            contracts: Contracts::default(),
            log: LogRing::begin(),
        });
        state.connect();
        state
    }

    /// Connects the ports of the layers.
    fn connect(self: &Arc<Self>) {
        let ports = &self.ctx.ports;
        ports.connect_applications(&(self.lncl.clone() as Arc<_>));
        ports.connect_links(&(self.gncl.clone() as Arc<_>));
        ports.connect_members(&(self.ndl.clone() as Arc<_>));
        ports.connect_names(&(self.sync.clone() as Arc<_>));
        ports.connect_app_lifecycle(&(self.sync.clone() as Arc<_>));
        ports.connect_app_types(&(self.clone() as Arc<_>));
        let audits = Arc::new(audit::Frames(Arc::downgrade(self)));
        // They are set once, here.
        let _ = self.sync.audits.set(audits);
        let _ = self.sync.triggers.set(Arc::new(Triggers(Arc::downgrade(self))));
        let types = Arc::new(types::Frames(Arc::downgrade(self)));
        let _ = self.sync.types.set(types);
    }

    /// Releases the node's socket and its address for inspection, so that another node can use them even if a
    /// hung thread still holds the state.
    pub(crate) fn close(&self) {
        self.real_time.end();
        self.lncl.client_socket.close();
        self.ctx.router.remove_local(AppAddress::INSPECT);
        self.ctx.router.remove_local(AppAddress::STOP);
        let recording = self.recording.end(self);
        self.types.close();
        self.gncl.store.close();
        self.gncl.store.end_threads();
        lock(&self.ndl.sockets).close_all();
        // Last: the disk of frozen spans may be slow.
        recording.wait();
    }

    /// Returns the state of a node that has only the layers that a test starts.
    #[cfg(test)]
    pub(crate) fn for_test(config: NodeConfig, incarnation: Incarnation) -> Arc<Self> {
        Self::new(config, incarnation)
    }
}
