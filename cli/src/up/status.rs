//! `sinew status`, and the logs of the nodes' processes, on all hosts.

use std::collections::{BTreeMap, BTreeSet};

use serde_json::{Value, json};

use super::{
    fleet::Fleet,
    protocol::{LOG_BYTES_MAX, NodeSeen, ProcessSeen, Request},
    robot::Robot,
    session::{Access, HostError},
    wait::{NodeState, judge},
};
use crate::{
    Report,
    system::SystemError,
    table::{Table, clean_lines, or_dash, short, time},
    unknown::suggestion,
};

/// Bytes of one node's log that are shown.
const LOG_BYTES: u64 = 64 << 10;

/// The nodes of a robot, as its hosts report them.
#[derive(Debug)]
pub(super) struct Nodes(Vec<Node>);

#[derive(Debug)]
struct Node {
    name: String,
    host: String,
    process: Option<ProcessSeen>,
    state: NodeState,
}

/// Shows the state of each node.
pub(super) fn show(robot: &Robot, is_wide: bool) -> Report {
    let (mut fleet, errors) = Fleet::enter(robot, Access::Look);
    let nodes = of_hosts(robot, &mut fleet, &errors);
    let is_fine = nodes.0.iter().all(|node| node.state == NodeState::Ready);
    let json = json!({ "robot": robot.name, "nodes": nodes.json() });
    Report { text: nodes.text(is_wide), json, is_fine }
}

/// Returns the nodes of a robot, if all hosts are connected.
pub(super) fn of(robot: &Robot, fleet: &mut Fleet) -> Nodes {
    of_hosts(robot, fleet, &BTreeMap::new())
}

fn of_hosts(robot: &Robot, fleet: &mut Fleet, errors: &BTreeMap<String, HostError>) -> Nodes {
    let observed = fleet.observe(true);
    let mut nodes = Vec::new();
    for (name, node) in &robot.nodes {
        let seen = observed.get(&node.host);
        let lost = errors.get(&node.host).or_else(|| seen.and_then(|seen| seen.as_ref().err()));
        let all = seen.and_then(|seen| seen.as_ref().ok());
        let seen = all.and_then(|all| all.iter().find(|seen| seen.order.name == *name));
        let state = lost.map_or_else(|| judge(&node.ready, seen), |why| NodeState::Unknown(why.to_string()));
        nodes.push(of_one(name, &node.host, seen, state));
    }
    let wanted: BTreeSet<_> =
        robot.nodes.iter().map(|(name, node)| (name.as_str(), node.host.as_str())).collect();
    for (host, seen) in &observed {
        let seen = seen.iter().flatten();
        for seen in seen.filter(|seen| !wanted.contains(&(seen.order.name.as_str(), host.as_str()))) {
            let why = "the robot file has no such node here; `sinew up` removes it";
            nodes.push(of_one(&seen.order.name, host, Some(seen), NodeState::Unknown(why.to_owned())));
        }
    }
    Nodes(nodes)
}

fn of_one(name: &str, host: &str, seen: Option<&NodeSeen>, state: NodeState) -> Node {
    let process = seen.and_then(|seen| seen.process.clone());
    Node { name: name.to_owned(), host: host.to_owned(), process, state }
}

impl Node {
    const fn word(&self) -> &'static str {
        match &self.state {
            NodeState::Ready => "ready",
            NodeState::Waits(_) => "waits",
            NodeState::Ended(_) => "ended",
            NodeState::Unknown(_) => "unknown",
        }
    }

    fn detail(&self) -> String {
        match &self.state {
            NodeState::Ready => String::new(),
            NodeState::Waits(reasons) => reasons.join("\n"),
            NodeState::Ended(lines) => lines.clone(),
            NodeState::Unknown(why) => why.clone(),
        }
    }
}

impl Nodes {
    fn text(&self, is_wide: bool) -> String {
        let heading = ["NODE", "HOST", "STATE", "PROCESS", "UP", "DETAIL"];
        let mut table = Table::new(heading).whole(&["NODE", "STATE", "PROCESS"]).wide(is_wide);
        for node in &self.0 {
            let process = node.process.as_ref();
            table.row([
                node.name.clone(),
                node.host.clone(),
                node.word().to_owned(),
                or_dash(process.map(|process| process.pid.to_string())),
                or_dash(process.map(|process| time(process.up_s.saturating_mul(1_000_000)))),
                node.detail(),
            ]);
        }
        table.text()
    }

    pub(super) fn json(&self) -> Vec<Value> {
        let node = |node: &Node| {
            let process = node.process.as_ref();
            json!({
                "name": node.name, "host": node.host, "state": node.word(),
                "process": process.map(|process| process.pid), "up_s": process.map(|process| process.up_s),
                "detail": node.detail(),
            })
        };
        self.0.iter().map(node).collect()
    }
}

/// Shows the end of the log of each node's process, or of one.
pub(super) fn logs(robot: &Robot, chosen: Option<&str>) -> Result<Report, SystemError> {
    if let Some(name) = chosen.filter(|name| !robot.nodes.contains_key(*name)) {
        let near = suggestion(name, robot.nodes.keys().map(String::as_str));
        return Err(SystemError::Unknown(format!(
            "the robot file has no node called `{}`{near}",
            short(name)
        )));
    }
    let (mut fleet, errors) = Fleet::enter(robot, Access::Look);
    let (mut text, mut json, mut is_fine) = (String::new(), Vec::new(), true);
    for (name, node) in robot.nodes.iter().filter(|(name, _)| chosen.is_none_or(|chosen| chosen == *name)) {
        let bytes_max = if chosen.is_some() { LOG_BYTES_MAX } else { LOG_BYTES };
        let asked = match errors.get(&node.host) {
            Some(error) => Err(error.clone()),
            None => fleet.order(&node.host, &Request::Log { node: name.clone(), bytes_max }),
        };
        is_fine &= asked.is_ok();
        let (log, fault) = match asked {
            Ok(log) => (log, None),
            Err(why) => (String::new(), Some(why.to_string())),
        };
        let shown = fault.as_ref().unwrap_or(&log);
        text += &format!("--- {name} on {}\n{}\n", node.host, clean_lines(shown));
        json.push(json!({ "node": name, "host": node.host, "log": log, "fault": fault }));
    }
    Ok(Report { text, json: json!({ "logs": json }), is_fine })
}
