//! The four nodes, each in a process on a host of its own, and the orders to them.

use std::{process::Stdio, time::Duration};

use serde_json::Value;
use sinew_testkit::{Hosts, NodeProcess, TestDirectory, own_group, unique, until};

use super::{LEAD, NODES, WITHIN};
use crate::role;

/// The result of a transaction, as its coordinator states it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Verdict {
    All,
    None,
    Repaired,
    Mixed,
}

/// The answer of a coordinator.
#[derive(Debug)]
pub(super) struct Answer {
    pub(super) verdict: Verdict,
    /// The nodes that got their values after the stated time.
    pub(super) repaired: Vec<usize>,
    #[expect(dead_code, reason = "a violation shows it")]
    why: String,
}

/// The value that the loop of a node has read last, and since when.
#[derive(Clone, Copy, Debug)]
pub(super) struct Seen {
    pub(super) value: u64,
    pub(super) since_ns: u64,
}

/// The nodes on their hosts.
pub(super) struct Robot {
    hosts: Hosts,
    _directory: TestDirectory,
    /// The arguments of all nodes: the group, the number of the project, and the access list.
    shared: [String; 3],
    nodes: Vec<NodeProcess>,
    /// Answers to orders that came before they were waited for, by coordinator.
    answers: Vec<Option<String>>,
}

impl Answer {
    /// Reads an answer; `None` if the transaction did not begin.
    fn read(line: &str) -> Option<Self> {
        let json: Value = serde_json::from_str(line).unwrap_or_else(|why| panic!("{why}: {line}"));
        let verdict = match json["verdict"].as_str() {
            Some("all") => Verdict::All,
            Some("none") => Verdict::None,
            Some("repaired") => Verdict::Repaired,
            Some("mixed") => Verdict::Mixed,
            _ => return None,
        };
        let repaired = json["repaired"].as_array().into_iter().flatten().filter_map(Value::as_u64);
        let repaired = repaired.map(|node| node as usize).collect();
        Some(Self { verdict, repaired, why: json["why"].as_str().unwrap_or_default().to_owned() })
    }
}

impl Robot {
    pub(super) fn start() -> Result<Self, String> {
        let hosts = Hosts::new(NODES as u8)?;
        let directory = TestDirectory::new();
        // No rule lets the applications send to each other: a transaction needs none.
        let access = directory.write("access.toml", "[roles]\noperators = ['operator.*']\n");
        let shared = [own_group().to_string(), unique().to_string(), access.display().to_string()];
        let answers = vec![None; NODES];
        let mut robot = Self { hosts, _directory: directory, shared, nodes: Vec::new(), answers };
        robot.nodes = (0..NODES).map(|node| robot.process(node)).collect();
        robot.nodes.iter_mut().for_each(|node| drop(node.wait_for(&["up"])));
        Ok(robot)
    }

    fn process(&self, node: usize) -> NodeProcess {
        let host = &self.hosts.all()[node];
        let mut command = role("param-node");
        command.arg(node.to_string()).arg(host.address.to_string()).args(&self.shared);
        let mut moved = host.moved(&command);
        // Each loss of a node is a warning.
        moved.stderr(Stdio::null());
        NodeProcess::start(&format!("node {node}"), moved)
    }

    /// Starts a node again that was killed.
    pub(super) fn start_node(&mut self, node: usize) {
        self.nodes[node] = self.process(node);
        self.answers[node] = None;
        self.nodes[node].wait_for(&["up"]);
    }

    pub(super) fn kill(&mut self, node: usize) {
        self.nodes[node].kill();
    }

    pub(super) fn cut(&self, node: usize) {
        self.hosts.cut(node);
    }

    pub(super) fn join(&self, node: usize) {
        self.hosts.join(node);
    }

    pub(super) fn look(&mut self, node: usize) -> Seen {
        let mut line = self.nodes[node].ask("look");
        if line.starts_with('{') {
            // The answer to an order has come before.
            let answer = std::mem::replace(&mut line, self.nodes[node].wait_for(&[]));
            self.answers[node] = Some(answer);
        }
        let [value, since_ns] = sinew_testkit::numbers(&line)[..] else { panic!("node {node}: {line:?}") };
        Seen { value, since_ns }
    }

    /// Orders a transaction, without a wait for the answer.
    pub(super) fn order(&mut self, coordinator: usize, value: u64, lead: Duration, within: Duration) {
        let (lead, within) = (lead.as_millis(), within.as_millis());
        self.nodes[coordinator].send_line(&format!("set {value} {lead} {within}"));
    }

    /// Waits for the answer to an order. A transaction that did not begin, since a node was killed before, is one
    /// without effect.
    pub(super) fn answer(&mut self, coordinator: usize) -> Answer {
        let line = self.answers[coordinator].take().unwrap_or_else(|| self.nodes[coordinator].wait_for(&[]));
        Answer::read(&line).unwrap_or_else(|| Answer {
            verdict: Verdict::None,
            repaired: Vec::new(),
            why: line,
        })
    }

    /// Gives all nodes this value as one transaction without a fault. It is repeated until all nodes know each other
    /// and have measured their clocks.
    pub(super) fn set_all(&mut self, coordinator: usize, value: u64) {
        let order = format!("set {value} {} {}", LEAD.as_millis(), WITHIN.as_millis());
        until("a transaction without a fault is applied by all", || {
            let answer = Answer::read(&self.nodes[coordinator].ask(&order));
            answer.filter(|answer| answer.verdict == Verdict::All).map(drop)
        });
        assert_eq!(self.wait_until_equal(), Some(value), "all have applied it");
    }

    /// Waits until all nodes have read the same value, and returns it; `None` if they differ at the end of the wait.
    pub(super) fn wait_until_equal(&mut self) -> Option<u64> {
        // A loop reads the value at its next tick; a doubt is settled within a second.
        for _ in 0..200 {
            let values: Vec<u64> = (0..NODES).map(|node| self.look(node).value).collect();
            if values.iter().all(|value| *value == values[0]) {
                return Some(values[0]);
            }
            std::thread::sleep(Duration::from_millis(20));
        }
        None
    }
}
