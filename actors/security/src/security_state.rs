//! The active security of a node, for all its layers.

use std::sync::{Arc, OnceLock};

use sinew_runtime::router::Router;

use crate::{access::Access, node_security::NodeSecurity};

/// The active security of a node. It outlives every layer, and is set before any layer starts.
#[derive(Default)]
pub struct SecurityState {
    /// How peers and this node authenticate to each other. Unset if the node is open.
    pub secured: OnceLock<NodeSecurity>,
    /// The access list for messages. If it is unset, every message is allowed.
    pub access: OnceLock<Arc<Access>>,
}

impl SecurityState {
    /// Puts an access list in force for all messages that are sent from now on.
    pub fn guard(&self, router: &Router, access: Arc<Access>) {
        router.set_guard(access.clone());
        // Each node sets its access list once; a second list would be ignored.
        let _ = self.access.set(access);
    }

    /// Puts an access list without a file in force.
    #[cfg(any(test, feature = "testing"))]
    pub fn access_in_test(&self, context: &sinew_model::context::NodeContext, text: &str) -> Arc<Access> {
        let access = Access::in_test(context.node, &context.refusals, text);
        self.guard(&context.router, access.clone());
        access
    }
}
