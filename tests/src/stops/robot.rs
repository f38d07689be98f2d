//! The four nodes, each in a process on a host of its own, and the orders to them.

use std::{process::Stdio, time::Duration};

use serde_json::Value;
use sinew_testkit::{Hosts, NodeProcess, TestDirectory, own_group, unique, until};

use super::NODES;
use crate::role;

/// The answer to a press, or to a question for its state.
#[derive(Debug)]
pub(super) struct Answer {
    /// When the press was ordered, on the clock of the machine.
    pub(super) pressed_ns: u64,
    state: String,
    is_confirmed: bool,
    refused: Option<String>,
    rows: Vec<Row>,
}

/// A node in an answer.
#[derive(Debug)]
pub(super) struct Row {
    node: String,
    state: String,
    pub(super) confirmed: Option<Duration>,
    pub(super) bound: Option<Duration>,
}

/// The guarded output of a node.
#[derive(Clone, Copy, Debug)]
pub(super) struct Output {
    pub(super) is_live: bool,
    /// When it was made safe last.
    pub(super) safe_ns: u64,
    /// Number of commands that reached it.
    pub(super) moved: u64,
}

/// The nodes on their hosts.
pub(super) struct Robot {
    hosts: Hosts,
    directory: TestDirectory,
    /// The arguments of all nodes: the group, the number of the project, the load, and the access list.
    shared: [String; 4],
    nodes: Vec<NodeProcess>,
}

impl Answer {
    fn read(line: &str) -> Self {
        let json: Value = serde_json::from_str(line).unwrap_or_else(|why| panic!("{why}: {line}"));
        let text = |value: &Value| value.as_str().map(str::to_owned);
        let time = |value: &Value| value.as_u64().map(Duration::from_micros);
        let row = |row: &Value| Row {
            node: text(&row["node"]).unwrap_or_default(),
            state: text(&row["state"]).unwrap_or_default(),
            confirmed: time(&row["confirmed_us"]),
            bound: time(&row["bound_us"]),
        };
        Self {
            pressed_ns: json["pressed_ns"].as_u64().unwrap_or_else(|| panic!("no report: {line}")),
            state: text(&json["state"]).unwrap_or_default(),
            is_confirmed: json["is_confirmed"] == true,
            refused: text(&json["refused"]),
            rows: json["nodes"].as_array().map(|rows| rows.iter().map(row).collect()).unwrap_or_default(),
        }
    }

    /// Returns the row of this node.
    pub(super) fn row(&self, node: usize) -> Option<&Row> {
        let address = format!("10.77.0.{}", node + 1);
        self.rows.iter().find(|row| row.node == address)
    }

    fn all_are(&self, state: &str) -> bool {
        self.state == state && self.rows.len() == NODES && self.rows.iter().all(|row| row.state == state)
    }
}

impl Robot {
    pub(super) fn start(load: u32) -> Result<Self, String> {
        let hosts = Hosts::new(NODES as u8)?;
        let directory = TestDirectory::new();
        let list = "[[rule]]\nfrom = ['*']\nto = ['*']\n[roles]\noperators = ['operator.*']\n";
        let access = directory.write("access.toml", list);
        let access = access.display().to_string();
        let shared = [own_group().to_string(), unique().to_string(), load.to_string(), access];
        let mut robot = Self { hosts, directory, shared, nodes: Vec::new() };
        robot.nodes = (0..NODES).map(|node| robot.process(node)).collect();
        robot.nodes.iter_mut().for_each(|node| drop(node.wait_for(&["up"])));
        Ok(robot)
    }

    fn process(&self, node: usize) -> NodeProcess {
        let host = &self.hosts.all()[node];
        let mut command = role("stop-node");
        command.arg(node.to_string()).arg(host.address.to_string()).args(&self.shared);
        command.arg(self.directory.join(&format!("state-{node}")));
        let mut moved = host.moved(&command);
        // Each press is a warning.
        moved.stderr(Stdio::null());
        NodeProcess::start(&format!("node {node}"), moved)
    }

    /// Starts a node again that was killed.
    pub(super) fn start_node(&mut self, node: usize) {
        self.nodes[node] = self.process(node);
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

    /// Waits until all nodes know each other, acknowledges the last stop, waits until all outputs move, and takes the
    /// permission to start back.
    pub(super) fn move_all(&mut self) {
        for node in 0..NODES {
            until("all nodes are known and released", || {
                self.ask(node, "status").all_are("released").then_some(())
            });
        }
        self.order_all("start");
        until("all outputs move", || (0..NODES).all(|node| self.output(node).is_live).then_some(()));
        self.order_all("hold");
    }

    fn order_all(&mut self, order: &str) {
        for node in &mut self.nodes {
            assert_eq!(node.ask(order), "done");
        }
    }

    pub(super) fn output(&mut self, node: usize) -> Output {
        let line = self.nodes[node].ask("output");
        let [is_live, safe_ns, moved] = sinew_testkit::numbers(&line)[..] else {
            panic!("node {node}: {line:?}")
        };
        Output { is_live: is_live == 1, safe_ns, moved }
    }

    /// Waits until the output of this node is safe, and returns when that was.
    pub(super) fn wait_until_safe(&mut self, node: usize) -> u64 {
        until("the output is safe", || {
            let output = self.output(node);
            (!output.is_live).then_some(output.safe_ns)
        })
    }

    /// Orders a press, without a wait for the answer.
    pub(super) fn order_press(&mut self, node: usize, within: Duration) {
        self.nodes[node].send_line(&format!("press {}", within.as_millis()));
    }

    /// Waits for the answer to an order.
    pub(super) fn answer(&mut self, node: usize) -> Answer {
        Answer::read(&self.nodes[node].wait_for(&[]))
    }

    fn ask(&mut self, node: usize, question: &str) -> Answer {
        Answer::read(&self.nodes[node].ask(question))
    }

    /// Waits until all four nodes have confirmed the stop.
    pub(super) fn wait_until_confirmed(&mut self, node: usize) {
        until("all nodes have confirmed", || {
            let answer = self.ask(node, "status");
            (answer.is_confirmed && answer.rows.len() == NODES).then_some(())
        });
    }

    /// Releases the stop, and waits until all nodes know that.
    pub(super) fn release(&mut self, node: usize) {
        let answer = self.ask(node, "release");
        assert_eq!(answer.refused, None, "its operator may release");
        until("all nodes are released", || self.ask(node, "status").all_are("released").then_some(()));
    }
}
