//! Runs an audit of one node, or of all nodes.

use std::{collections::BTreeSet, sync::atomic::Ordering, time::Duration};

use super::NodeHandle;
use crate::audit::{self, Audit, NodeAudit};

/// Why there is no audit. Nothing changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AuditError {
    /// The node does not run.
    #[error("the node does not run")]
    NotRunning,
    /// The maximum number of threads runs audits, or recent ones leave no turn within the time; wait for one
    /// of them, or longer.
    #[error(
        "too many audits of this node are under way, or were within the last second; wait for one of them, or longer"
    )]
    TooMany,
}

impl NodeHandle {
    /// Returns the current location of every message that this node has taken. Locks each mailbox and each
    /// connection briefly, one after the other, and waits for no answer.
    #[must_use]
    pub fn audit_here(&self) -> NodeAudit {
        audit::read(&self.state)
    }

    /// Returns the location of every message of the system. Asks every known node twice and compares the
    /// reports, so that each message that is not accounted for is attributed to a place or a link. Waits for
    /// `within` at most, half of it for the first answers, and then lists the nodes that have not answered.
    /// Not for an actor's handler, which it would block; use a thread of its own.
    ///
    /// It costs each node twice the cost of [`audit_here`](Self::audit_here), and two messages of class Bulk.
    /// A node answers 8 audits a second of each other node, and 32 in total; this node asks for at most 4 a
    /// second, and the next one waits for its turn.
    ///
    /// # Errors
    /// The node does not run, the maximum number of threads runs audits, or no turn is free within this time.
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::{node::AuditError, prelude::*};
    ///
    /// /// At the end of a trial: whether each message can be explained.
    /// fn check(handle: &sinew::NodeHandle) -> Result<bool, AuditError> {
    ///     let audit = handle.audit(Duration::from_secs(2))?;
    ///     println!("{audit}");
    ///     Ok(audit.missing() == 0)
    /// }
    /// ```
    pub fn audit(&self, within: Duration) -> Result<Audit, AuditError> {
        if self.hosts_other_node || self.state.ctx.stopping.load(Ordering::Relaxed) {
            return Err(AuditError::NotRunning);
        }
        let members = self.members().into_iter().map(|member| member.node);
        let linked = self.state.gncl.store.peers().into_iter().map(|peer| peer.node);
        let others: BTreeSet<_> = members.chain(linked).filter(|node| *node != self.state.ctx.node).collect();
        audit::audit(&self.state, &others, within).map_err(|_| AuditError::TooMany)
    }
}
