//! The question about the location of every message of a node, and its answer.

use serde::{Deserialize, Serialize};
use sinew_runtime::wire::Payload;

use super::Report;
use crate::audit::{NodeAudit, put_together};

/// Asks for the location of every message that the node ever had. [`AuditReport`] answers.
#[derive(Clone, Copy, Debug, Default, Serialize, Deserialize)]
pub struct AskAudit {}

impl Payload for AskAudit {
    const NAME: &'static str = "sinew.inspect.audit";
}

/// The outcomes of the messages of a node, at one moment. [`Audit::of_readings`](crate::audit::Audit::of_readings)
/// compares those of all nodes.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
pub struct AuditReport {
    /// The node's report about itself. Applications that do not fit are counted together.
    pub audit: NodeAudit,
}

impl Payload for AuditReport {
    const NAME: &'static str = "sinew.inspect.audit_report";
}

impl Report for AuditReport {
    fn halve(&mut self) -> bool {
        put_together(&mut self.audit)
    }
}
