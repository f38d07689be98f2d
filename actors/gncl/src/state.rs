//! The state of GNCL that outlives its actor.

use std::sync::Arc;

#[cfg(any(test, feature = "testing"))]
use sinew_model::config::NodeConfig;
use sinew_model::context::NodeContext;
#[cfg(any(test, feature = "testing"))]
use sinew_runtime::tid::Incarnation;
use sinew_security::SecurityState;

use super::{LinkEvents, Store, node_down_events::NodeDownEvents};

/// The state of GNCL that outlives its actor. The node's root lends it to each new instance.
pub struct State {
    /// What all layers share.
    pub ctx: Arc<NodeContext>,
    /// The security in force.
    pub security: Arc<SecurityState>,
    /// The peers with their queued messages, and the counts of refused inputs.
    pub store: Store,
    /// Link events that are pending for other layers because their event queues were full.
    pub link_events: LinkEvents,
    /// Node-down events that must be delivered after the last messages of those nodes.
    pub node_down_events: NodeDownEvents,
}

impl State {
    /// Returns the state of a node that has not started yet.
    pub fn new(ctx: Arc<NodeContext>, security: Arc<SecurityState>) -> Arc<Self> {
        let link_events = LinkEvents::new(ctx.config.ndl.nodes_max);
        Arc::new(Self {
            ctx,
            security,
            store: Store::default(),
            link_events,
            node_down_events: NodeDownEvents::default(),
        })
    }

    /// Returns the state of a node that has only this layer.
    #[cfg(any(test, feature = "testing"))]
    pub fn for_test(config: NodeConfig, incarnation: Incarnation) -> Arc<Self> {
        Self::new(NodeContext::for_test(config, incarnation).0, Arc::default())
    }
}
