//! Asks a node where every message is.

use super::NodeHandle;
use crate::audit::{self, NodeAudit};

impl NodeHandle {
    /// Where every message is that this node has taken, now. Locks each mailbox and each connection for a moment, one after the
    /// other, and waits for nobody.
    #[must_use]
    pub fn audit_here(&self) -> NodeAudit {
        audit::read(&self.stores)
    }
}
