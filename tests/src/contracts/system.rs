//! The three nodes, each in a process of its own, and the orders to them.

use std::{net::SocketAddr, process::Stdio, time::Duration};

use rustix::process::Signal;
use sinew_testkit::{
    NodeProcess, TestDirectory,
    network::{FaultyNetwork, Listener, Side},
    numbers, own_group, unique, until,
};

use super::{NODES, SLACK};
use crate::role;

/// The number of the conditions of both contracts.
const ROWS: u64 = 6;

/// The nodes. The first one is `central`.
pub(super) struct System {
    directory: TestDirectory,
    /// The arguments of all nodes: the group, and the number of the project.
    shared: [String; 2],
    /// The connections between the nodes: `central` is on the left.
    network: FaultyNetwork,
    nodes: Vec<NodeProcess>,
}

impl System {
    pub(super) fn start() -> Self {
        let shared = [own_group().to_string(), unique().to_string()];
        let listen = SocketAddr::from(([127, 0, 0, 1], 0));
        let sides = [Side::Left, Side::Right, Side::Right];
        let listeners = sides.map(|side| Listener { side, listen, datagrams: false });
        let network = FaultyNetwork::start(&listeners, 1).expect("ports on loopback");
        let mut system = Self { directory: TestDirectory::new(), shared, network, nodes: Vec::new() };
        system.nodes = (0..NODES.len()).map(|node| system.process(node)).collect();
        (0..NODES.len()).for_each(|node| system.connect(node));
        system
    }

    /// Waits until a node is up, and leads its connections to it.
    fn connect(&mut self, node: usize) {
        let line = self.nodes[node].wait_for(&["up"]);
        let address = line.trim_end().strip_prefix("up ").and_then(|address| address.parse().ok());
        self.network.set_destination(node, address.unwrap_or_else(|| panic!("{line:?}")));
    }

    fn process(&self, node: usize) -> NodeProcess {
        let mut command = role("contract-node");
        command.arg(node.to_string()).args(&self.shared).arg(self.directory.join(""));
        command.arg(SLACK.as_millis().to_string()).arg("none").arg(self.network.address(node).to_string());
        // Each loss is a warning.
        command.stderr(Stdio::null());
        NodeProcess::start(NODES[node], command)
    }

    pub(super) fn wait_until_outputs_are_live(&mut self) {
        until("both outputs are live", || {
            let mut drives = self.nodes.iter_mut().skip(1);
            drives.all(|drive| output(drive).0).then_some(())
        });
    }

    /// Waits until the output of this node is safe, and returns when that was.
    pub(super) fn wait_until_safe(&mut self, name: &str) -> u64 {
        let at = NODES.iter().position(|node| *node == name).expect("it is one of the nodes");
        let drive = &mut self.nodes[at];
        until("the output is safe", || {
            let (is_live, safe_ns) = output(drive);
            (!is_live).then_some(safe_ns)
        })
    }

    /// Waits until all contracts are known and close, and all outputs are measured. Returns the longest dry run.
    ///
    /// # Panics
    /// If that does not come true in time.
    pub(super) fn wait_until_contracts_close(&mut self) -> Duration {
        let drive = &mut self.nodes[1];
        until("all contracts close, and the outputs are measured", || {
            let line = drive.ask("check");
            let [closes, rows, measured] = numbers(&line)[..] else { panic!("{line:?}") };
            // The names of a node that was found just now come later.
            (closes == 1 && rows == ROWS && measured > 0).then(|| Duration::from_micros(measured))
        })
    }

    pub(super) fn kill_central(&mut self) {
        // As on a host of its own: nothing listens in its place.
        self.network.refuse(true);
        self.nodes[0].kill();
    }

    pub(super) fn pause_central(&self) {
        self.nodes[0].signal(Signal::STOP);
    }

    pub(super) fn resume_central(&self) {
        self.nodes[0].signal(Signal::CONT);
    }

    /// Holds back what the drives send to `central`. Its commands quote older and older echoes: they become late.
    pub(super) fn delay_central(&self) {
        self.network.change(Side::Left, |faults| faults.parted = true);
    }

    pub(super) fn end_delay(&self) {
        self.network.change(Side::Left, |faults| faults.parted = false);
    }

    pub(super) fn order_central_to_leave(&mut self) {
        self.nodes[0].send_line("leave");
    }

    /// Starts `central` again, after its process has ended.
    pub(super) fn start_central(&mut self) {
        self.nodes[0].wait_for_exit();
        self.nodes[0] = self.process(0);
        self.connect(0);
        self.network.refuse(false);
    }

    pub(super) fn press(&mut self, within: Duration) {
        self.nodes[0].send_line(&format!("press {}", within.as_millis()));
    }

    /// Waits for the answer to the press, and releases it.
    pub(super) fn release(&mut self) {
        self.nodes[0].wait_for(&["pressed"]);
        self.nodes[0].send_line("release");
        let answer = self.nodes[0].wait_for(&["released"]);
        assert_eq!(answer.trim_end(), "released", "its operator may release");
    }
}

/// Returns whether the output of a node is live, and when it was made safe last.
fn output(drive: &mut NodeProcess) -> (bool, u64) {
    let line = drive.ask("output");
    let [is_live, safe_ns] = numbers(&line)[..] else { panic!("{line:?}") };
    (is_live == 1, safe_ns)
}
