//! The types of payloads as nodes know them: structures, and protected types.

use std::{collections::BTreeSet, time::Duration};

use sinew::{
    AppAddress, NodeAddress, Payload, Tid,
    client::ApiError,
    inspect::{AskNode, AskSchemas, NodeReport, SchemaReport, SchemasReport},
    message::Kind,
    schema::Schema,
};

use crate::{Destination, NodeClient};

/// Maximum number of nodes that are asked for the types that their applications guard.
const NODES_MAX: usize = 256;

/// The protected types of all nodes, as far as nodes report them.
#[derive(Clone, Debug, Default, PartialEq, Eq)]
pub struct ProtectedTypes {
    /// The names of the types that an application in a node's process guards.
    pub names: BTreeSet<String>,
    /// Whether a node has not answered, or has more than it reports.
    pub is_incomplete: bool,
}

impl NodeClient {
    /// Returns the structure of a type as the destination handles it; `None` if it is not known. For several
    /// receivers: the structure that all known receivers have.
    ///
    /// # Errors
    /// The node did not answer `within` this time.
    pub async fn structure_handled(
        &mut self,
        kind: Kind,
        to: &Destination,
        within: Duration,
    ) -> Result<Option<Schema>, ApiError> {
        let to = self.find(to).await?;
        let node = if to.is_single() { to.node } else { self.tid().node };
        let report: SchemasReport = self.inspect(node, &AskSchemas { kind }, within).await?;
        let is_used = |one: &&SchemaReport| {
            !one.handled_by.is_empty()
                && (!to.is_single() || one.handled_by.iter().any(|user| user.tid == to))
        };
        let mut used = report.schemas.iter().filter(is_used);
        Ok(match (used.next(), used.next()) {
            (Some(one), None) => parsed(one),
            // Receivers differ: each payload is judged by its receiver.
            (Some(_), Some(_)) | (None, _) => None,
        })
    }

    /// Asks all nodes for the types that their applications guard. An application in a process of its own is in no
    /// report: it refuses unprotected commands itself.
    ///
    /// # Errors
    /// The own node did not answer `within` this time.
    pub async fn protected_types(&mut self, within: Duration) -> Result<ProtectedTypes, ApiError> {
        let here: NodeReport = self.inspect(self.tid().node, &AskNode {}, within).await?;
        let peers = here.peers.iter().filter(|peer| peer.is_there).map(|peer| peer.node);
        let peers: Vec<NodeAddress> = peers.take(NODES_MAX).collect();
        let mut found = ProtectedTypes { is_incomplete: here.left_out > 0, ..ProtectedTypes::default() };
        found.add(&here);
        for node in peers {
            match self.inspect::<_, NodeReport>(node, &AskNode {}, within).await {
                Ok(report) => found.add(&report),
                Err(_) => found.is_incomplete = true,
            }
        }
        Ok(found)
    }

    async fn inspect<Q: Payload, R: Payload>(
        &mut self,
        node: NodeAddress,
        question: &Q,
        within: Duration,
    ) -> Result<R, ApiError> {
        let to = Tid::new(node, AppAddress::INSPECT);
        self.endpoint.message(to, question).ask(within).await
    }
}

impl ProtectedTypes {
    fn add(&mut self, report: &NodeReport) {
        self.names.extend(report.guards.iter().map(|guard| guard.kind_name.clone()));
        self.is_incomplete |= report.guards_left_out > 0;
    }
}

/// Returns the structure of a report, if it is the one of its hash.
fn parsed(report: &SchemaReport) -> Option<Schema> {
    let schema = Schema::parse(report.schema.as_deref()?).ok()?;
    (schema.hash() == report.hash).then_some(schema)
}
