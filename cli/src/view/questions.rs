//! The questions to the nodes for one snapshot, and their time limits.

use std::time::Duration;

use sinew::{
    AppAddress, Endpoint, NodeAddress, Payload, Tid, Time,
    inspect::{AskApps, AskAudit, AskLogs, AskNode, AskTree, AuditReport, LogLine, LogsReport, NodeReport},
};
use sinew_view::{Answers, NodeAnswers};

use super::SNAPSHOT_WITHIN;
use crate::system::ask;

/// Number of warnings and errors of each node in one snapshot.
const WARNINGS: u32 = 16;

/// The time limits of the questions of one snapshot.
#[derive(Clone, Copy)]
pub(super) struct Questions {
    pub(super) within: Duration,
    pub(super) until: Time,
}

impl Questions {
    /// Returns the time limit for the next answer, if there is time left.
    pub(super) fn left(self) -> Result<Duration, String> {
        let left = self.until.since(Time::now()).min(self.within);
        if left.is_zero() {
            return Err(format!("not asked: other answers have taken all of {SNAPSHOT_WITHIN:?}"));
        }
        Ok(left)
    }

    pub(super) fn ask<Q: Payload + Default, R: Payload>(
        self,
        endpoint: &mut Endpoint,
        node: NodeAddress,
    ) -> Result<R, String> {
        ask::<Q, R>(endpoint, node, self.left()?)
    }

    /// Asks a node all questions, or up to the first one without an answer.
    pub(super) fn ask_node(
        self,
        endpoint: &mut Endpoint,
        here: &NodeReport,
        (node, name): &(NodeAddress, String),
    ) -> NodeAnswers {
        let result = self.answers(endpoint, here, *node);
        NodeAnswers { node: *node, name: name.clone(), result: result.map(Box::new) }
    }

    fn answers(
        self,
        endpoint: &mut Endpoint,
        here: &NodeReport,
        node: NodeAddress,
    ) -> Result<Answers, String> {
        let report =
            if node == here.node { here.clone() } else { self.ask::<AskNode, NodeReport>(endpoint, node)? };
        Ok(Answers {
            node: report,
            apps: self.ask::<AskApps, _>(endpoint, node)?,
            tree: self.ask::<AskTree, _>(endpoint, node)?,
            audit: self.ask::<AskAudit, AuditReport>(endpoint, node)?.audit,
            log: self.warnings(endpoint, node),
        })
    }

    /// Returns the newest warnings and errors of a node. An older version has none for this question.
    fn warnings(self, endpoint: &mut Endpoint, node: NodeAddress) -> Vec<LogLine> {
        let question =
            AskLogs { level: Some("warn".to_owned()), newest: Some(WARNINGS), ..AskLogs::default() };
        let Ok(left) = self.left() else { return Vec::new() };
        let to = Tid::new(node, AppAddress::INSPECT);
        let report = endpoint.message(to, &question).ask::<LogsReport>(left);
        report.map(|report| report.lines).unwrap_or_default()
    }
}
