//! `sinew view`: serves the state of all nodes as metrics.
//!
//! Each snapshot has endpoints of its own: one that stayed would leave unread each broadcast between two snapshots, and
//! its node would report a client that does not read. They are dropped without a wait for the node, which may have died
//! meanwhile.

use std::{collections::BTreeSet, net::SocketAddr, time::Duration};

use clap::Args;
use serde_json::json;
use sinew::{
    Endpoint, NodeAddress, NodeApi, Payload, Tid, Time,
    inspect::{AskApps, AskAudit, AskNode, AskTree, AuditReport, NodeReport},
};
use sinew_view::{Answers, NODES_MAX, NodeAnswers, Server, Snapshot, Source};

use crate::{
    Report,
    arguments::Arguments,
    output, sockets,
    system::{REQUESTERS_MAX, SystemError, ask, present, register},
    table::clean,
};

/// Time limit for a snapshot, below that of a request.
const SNAPSHOT_WITHIN: Duration = Duration::from_secs(4);

/// The arguments of `sinew view`.
#[derive(Debug, Args)]
pub(crate) struct Order {
    /// The address and port to listen on. Any other address than one of loopback can be read by each program on that
    /// network
    #[arg(long, value_name = "ADDRESS:PORT", default_value = "127.0.0.1:9464")]
    listen: SocketAddr,
}

/// Serves metrics until the user ends it.
pub(crate) fn show(order: &Order, arguments: &Arguments) -> Result<Report, SystemError> {
    let (path, api) = sockets::find(arguments.socket.as_deref())?;
    let path = path.display().to_string();
    let mut nodes = Nodes { api, within: arguments.within() };
    // As with other commands, a node that refuses or is silent at the start is an error.
    if let Err(why) = nodes.snapshot().entry {
        return Err(SystemError::NoAnswer(path, why));
    }
    let server = Server::bind(order.listen).map_err(|why| {
        let listen = order.listen;
        SystemError::View(format!("{listen} cannot be listened on: {why}; choose another one with --listen"))
    })?;
    let address = server.address();
    if !address.ip().is_loopback() {
        output::note(format_args!(
            "sinew: warning: {address} is not loopback: every program that reaches it can read the state of all nodes, without encryption"
        ));
    }
    let announcement = if arguments.json {
        json!({ "listens": address.to_string(), "through": path }).to_string()
    } else {
        format!(
            "http://{address}/metrics has the metrics of all nodes, through {}; Ctrl-C ends it",
            clean(&path)
        )
    };
    output::line(&announcement);
    let end = server.run(nodes);
    end.map_err(|why| {
        SystemError::View(format!("the system gives no thread or descriptor: {why}; free some"))
    })?;
    Ok(Report { text: String::new(), json: serde_json::Value::Null, is_fine: true })
}

/// All nodes, asked through one of them.
struct Nodes {
    api: NodeApi,
    /// Time limit for each answer.
    within: Duration,
}

impl Source for Nodes {
    fn snapshot(&mut self) -> Snapshot {
        let taken = Time::now();
        let until = taken + SNAPSHOT_WITHIN;
        let questions = Questions { within: self.within, until };
        self.ask_all(questions, taken).unwrap_or_else(|why| Snapshot::without_entry(taken, why))
    }
}

impl Nodes {
    fn ask_all(&self, questions: Questions, taken: Time) -> Result<Snapshot, String> {
        let mut first = register(&self.api, questions.left()?).map_err(|why| why.to_string())?;
        let entry = first.tid().node;
        let here = questions.ask::<AskNode, NodeReport>(&mut first, entry)?;
        let mut nodes = present(&here);
        let left_out = nodes.len().saturating_sub(NODES_MAX) as u64;
        nodes.truncate(NODES_MAX);
        let (own, nodes) = self.ask_nodes(first, &here, &nodes, questions);
        let took = Time::now().since(taken);
        Ok(Snapshot { taken, took, entry: Ok(here), nodes, left_out, own })
    }

    /// Asks these nodes, several at the same time: one that does not answer delays only a part of the others.
    fn ask_nodes(
        &self,
        first: Endpoint,
        here: &NodeReport,
        nodes: &[(NodeAddress, String)],
        questions: Questions,
    ) -> (BTreeSet<Tid>, Vec<NodeAnswers>) {
        let mut own = BTreeSet::from([first.tid()]);
        let mut endpoints = vec![first];
        while endpoints.len() < nodes.len().min(REQUESTERS_MAX) {
            let next = questions.left().ok().and_then(|left| register(&self.api, left).ok());
            // With fewer endpoints it takes longer.
            let Some(next) = next else { break };
            own.insert(next.tid());
            endpoints.push(next);
        }
        let count = endpoints.len();
        let mut answers = std::thread::scope(|scope| {
            let parts = endpoints.iter_mut().enumerate().map(|(number, endpoint)| {
                let part = nodes.iter().skip(number).step_by(count);
                scope.spawn(move || {
                    part.map(|node| questions.ask_node(endpoint, here, node)).collect::<Vec<_>>()
                })
            });
            let parts: Vec<_> = parts.collect();
            let joined = parts.into_iter().map(|part| part.join().expect("a requester does not panic"));
            joined.flatten().collect::<Vec<_>>()
        });
        answers.sort_by_key(|answer| answer.node);
        (own, answers)
    }
}

/// The time limits of the questions of one snapshot.
#[derive(Clone, Copy)]
struct Questions {
    within: Duration,
    until: Time,
}

impl Questions {
    /// Returns the time limit for the next answer, if there is time left.
    fn left(self) -> Result<Duration, String> {
        let left = self.until.since(Time::now()).min(self.within);
        if left.is_zero() {
            return Err(format!("not asked: other answers have taken all of {SNAPSHOT_WITHIN:?}"));
        }
        Ok(left)
    }

    fn ask<Q: Payload + Default, R: Payload>(
        self,
        endpoint: &mut Endpoint,
        node: NodeAddress,
    ) -> Result<R, String> {
        ask::<Q, R>(endpoint, node, self.left()?)
    }

    /// Asks a node all questions, or up to the first one without an answer.
    fn ask_node(
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
        })
    }
}
