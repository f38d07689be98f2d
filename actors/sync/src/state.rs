//! The state of the sync manager that outlives its actor.

use std::sync::{Arc, Mutex, OnceLock};

#[cfg(any(test, feature = "testing"))]
use sinew_model::config::NodeConfig;
use sinew_model::context::NodeContext;
#[cfg(any(test, feature = "testing"))]
use sinew_runtime::tid::Incarnation;
use sinew_runtime::{tid::NodeAddress, wire::Message};
use sinew_security::SecurityState;

use super::{Core, monitors, wills};

/// Handles frames of one kind that other nodes send to this node's sync manager.
pub trait FrameHandler: Send + Sync {
    /// Handles a frame of `from`.
    ///
    /// # Errors
    /// Returns a description of the fault if the frame is invalid.
    fn receive(&self, from: NodeAddress, message: &Message) -> Result<(), String>;
}

/// The state of the sync manager that outlives its actor. The node's root lends it to each new instance.
pub struct State {
    /// What all layers share.
    pub ctx: Arc<NodeContext>,
    /// The security in force.
    pub security: Arc<SecurityState>,
    /// The applications of other nodes, and the waiters.
    pub core: Mutex<Core>,
    /// Which application monitors which.
    pub monitors: Mutex<monitors::Core>,
    /// The last wills of applications: those held for other nodes, and those that other nodes hold.
    pub wills: Mutex<wills::Core>,
    /// Handles audits, which travel to the sync manager's TID.
    pub audits: OnceLock<Arc<dyn FrameHandler>>,
    /// Handles the triggers of recordings, which travel to the sync manager's TID.
    pub triggers: OnceLock<Arc<dyn FrameHandler>>,
    /// Handles frames about the structures of types, which travel to the sync manager's TID.
    pub types: OnceLock<Arc<dyn FrameHandler>>,
}

impl State {
    /// Returns the state of a node that has not started yet.
    pub fn new(ctx: Arc<NodeContext>, security: Arc<SecurityState>) -> Arc<Self> {
        let (node, incarnation) = (ctx.node, ctx.incarnation);
        let (nodes_max, payload_max) = (ctx.config.ndl.nodes_max, ctx.config.payload_max);
        Arc::new(Self {
            core: Mutex::new(Core::new(&ctx.config, node, incarnation)),
            monitors: Mutex::new(monitors::Core::new(node, incarnation, nodes_max, payload_max)),
            wills: Mutex::new(wills::Core::new(incarnation, nodes_max, payload_max)),
            audits: OnceLock::new(),
            triggers: OnceLock::new(),
            types: OnceLock::new(),
            ctx,
            security,
        })
    }

    /// Returns the state of a node that has only this layer.
    #[cfg(any(test, feature = "testing"))]
    pub fn for_test(config: NodeConfig, incarnation: Incarnation) -> Arc<Self> {
        Self::new(NodeContext::for_test(config, incarnation).0, Arc::default())
    }
}
