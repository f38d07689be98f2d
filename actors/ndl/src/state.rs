//! The state of NDL that outlives its actor.

use std::sync::{Arc, Mutex};

#[cfg(any(test, feature = "testing"))]
use sinew_model::config::NodeConfig;
use sinew_model::context::NodeContext;
#[cfg(any(test, feature = "testing"))]
use sinew_runtime::tid::Incarnation;
use sinew_security::SecurityState;

use super::{
    Core, MemberEvents, Sockets, new_core,
    node_events::{self, NodeEvents},
};

/// The state of NDL that outlives its actor. The node's root lends it to each new instance.
pub struct State {
    /// What all layers share.
    pub ctx: Arc<NodeContext>,
    /// The security in force.
    pub security: Arc<SecurityState>,
    /// The known nodes. A restarted NDL continues with them.
    pub core: Mutex<Core>,
    /// The sockets for queries and answers. They stay open while NDL is restarted.
    pub sockets: Mutex<Sockets>,
    /// The change count that the file of remembered peers reflects. The thread that writes the file holds
    /// this lock, never a layer's own thread.
    pub file: Mutex<u64>,
    /// Events that are pending for other layers because their event queues were full.
    pub member_events: MemberEvents,
    /// Events that are pending for applications because their mailboxes were full.
    pub node_events: NodeEvents,
}

impl State {
    /// Returns the state of a node that has not started yet.
    pub fn new(ctx: Arc<NodeContext>, security: Arc<SecurityState>) -> Arc<Self> {
        let core = Mutex::new(new_core(&ctx.config, ctx.node, ctx.incarnation));
        let member_events = MemberEvents::new(ctx.config.ndl.nodes_max);
        let node_events = node_events::new(ctx.config.ndl.nodes_max);
        Arc::new(Self {
            ctx,
            security,
            core,
            sockets: Mutex::default(),
            file: Mutex::default(),
            member_events,
            node_events,
        })
    }

    /// Returns the state of a node that has only this layer.
    #[cfg(any(test, feature = "testing"))]
    pub fn for_test(config: NodeConfig, incarnation: Incarnation) -> Arc<Self> {
        Self::new(NodeContext::for_test(config, incarnation).0, Arc::default())
    }
}
