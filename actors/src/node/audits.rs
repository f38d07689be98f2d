//! Asks a node, or all of them, where every message is.

use std::{collections::BTreeSet, sync::atomic::Ordering, time::Duration};

use super::NodeHandle;
use crate::audit::{self, Audit, NodeAudit};

/// Why there is no audit. Nothing has changed.
#[derive(Clone, Copy, Debug, PartialEq, Eq, thiserror::Error)]
pub enum AuditError {
    /// The node does not run.
    #[error("the node does not run")]
    NotRunning,
    /// So many threads are at it already, or were so lately that the turn of one more is behind its time; wait for one of them, or longer.
    #[error(
        "too many audits of this node are under way, or were within the last second; wait for one of them, or longer"
    )]
    TooMany,
}

impl NodeHandle {
    /// Where every message is that this node has taken, now. Locks each mailbox and each connection for a moment, one after the
    /// other, and waits for nobody.
    #[must_use]
    pub fn audit_here(&self) -> NodeAudit {
        audit::read(&self.stores)
    }

    /// Where every message of the system is: asks every node that is known, twice, and puts what they say side by side, so that a
    /// message that nobody can explain has the name of a place or of a link. Waits for `within` at most, and then says who has not
    /// answered; half of it for the first answers. Not for an actor's handler, which it would hold up: for a thread of its own.
    ///
    /// It costs each node what [`audit_here`](Self::audit_here) costs, twice, and two messages of class Bulk. A node answers 8 audits
    /// a second of each other one, and 32 of all together; this one asks for 4 a second at most, and the next one waits for its turn.
    ///
    /// # Errors
    /// The node does not run, too many threads are at it already, or it is no one's turn within this time.
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
        if self.is_bystander || self.stores.stopping.load(Ordering::Relaxed) {
            return Err(AuditError::NotRunning);
        }
        let members = self.members().into_iter().map(|member| member.node);
        let linked = self.stores.gncl.peers().into_iter().map(|peer| peer.node);
        let others: BTreeSet<_> = members.chain(linked).filter(|node| *node != self.stores.node).collect();
        audit::audit(&self.stores, &others, within).map_err(|_| AuditError::TooMany)
    }
}
