//! Nodes that start, stop and restart normally: they log no warning, in any order.

use rustix::process::Signal;
use sinew_testkit::{NodeProcess, TestDirectory, own_group};
use sinew_tests::node_under_test;

const NAMES: [&str; 4] = ["a", "b", "c", "d"];

/// Some nodes on loopback.
struct Scenario {
    directory: TestDirectory,
    group: std::net::SocketAddrV4,
    count: usize,
}

impl Scenario {
    fn new(count: usize) -> Self {
        Self { directory: TestDirectory::new(), group: own_group(), count }
    }

    fn start(&self, nth: usize) -> NodeProcess {
        let name = NAMES[nth];
        let text = format!(
            "[node]\nname = \"{name}\"\naddress = \"127.0.0.{}\"\nproject = \"healthy\"\n\
             [ndl]\nmulticast = \"{}\"\nmdns_port = false\n",
            nth + 1,
            self.group
        );
        let path = self.directory.write(&format!("{name}.toml"), &text);
        node_under_test(None, &path, &["--logs"])
    }

    /// Each of these has found all others.
    fn all_meet(&self, nodes: &mut [NodeProcess]) {
        for (nth, node) in nodes.iter_mut().enumerate() {
            for other in (0..self.count).filter(|other| *other != nth) {
                node.wait_for(&["NodeFound", &format!("\"{}\"", NAMES[other])]);
            }
        }
    }
}

/// Stops a node in order, and checks that it has logged no warning.
fn stop(mut node: NodeProcess) {
    node.signal(Signal::TERM);
    assert_eq!(node.wait_for_exit(), Some(0));
    is_calm(&node);
}

fn is_calm(node: &NodeProcess) {
    let warnings: Vec<_> =
        node.output().iter().filter(|line| line.contains(" WARN ") || line.contains("ERROR")).collect();
    assert!(warnings.is_empty(), "{warnings:#?}");
}

#[test]
fn simultaneous_start_and_ordered_stop_warn_of_nothing() {
    for round in 0..6 {
        let scenario = Scenario::new(2 + round % 3);
        let mut nodes: Vec<_> = (0..scenario.count).map(|nth| scenario.start(nth)).collect();
        scenario.all_meet(&mut nodes);
        if round % 2 == 0 {
            nodes.reverse();
        }
        nodes.into_iter().for_each(stop);
    }
}

#[test]
fn ordered_start_and_simultaneous_stop_warn_of_nothing() {
    let scenario = Scenario::new(3);
    let mut nodes = Vec::new();
    for nth in 0..3 {
        let mut node = scenario.start(nth);
        node.wait_for(&["up"]);
        nodes.push(node);
    }
    scenario.all_meet(&mut nodes);
    nodes.iter().for_each(|node| node.signal(Signal::TERM));
    for mut node in nodes {
        assert_eq!(node.wait_for_exit(), Some(0));
        is_calm(&node);
    }
}

#[test]
fn restart_of_a_node_warns_of_nothing() {
    let scenario = Scenario::new(3);
    let mut nodes: Vec<_> = (0..3).map(|nth| scenario.start(nth)).collect();
    scenario.all_meet(&mut nodes);
    for _ in 0..3 {
        stop(nodes.remove(0));
        for node in &mut nodes {
            node.wait_for(&["NodeLost", "\"a\""]);
        }
        let mut again = scenario.start(0);
        for other in ["\"b\"", "\"c\""] {
            again.wait_for(&["NodeFound", other]);
        }
        for node in &mut nodes {
            // Its next incarnation.
            node.wait_for(&["event Node", "\"a\""]);
        }
        nodes.insert(0, again);
    }
    nodes.into_iter().for_each(stop);
}
