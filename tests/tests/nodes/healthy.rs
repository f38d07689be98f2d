//! Nodes that start, stop and are started again as they should: nothing is warned of, in whichever order.

use rustix::process::Signal;
use sinew_tests::{OwnDirectory, Program, node_under_test, own_group};

const NAMES: [&str; 4] = ["a", "b", "c", "d"];

/// Some nodes on loopback.
struct Scenario {
    directory: OwnDirectory,
    group: std::net::SocketAddrV4,
    count: usize,
}

impl Scenario {
    fn new(count: usize) -> Self {
        Self { directory: OwnDirectory::new(), group: own_group(), count }
    }

    fn start(&self, nth: usize) -> Program {
        let name = NAMES[nth];
        let path = self.directory.join(&format!("{name}.toml"));
        let text = format!(
            "[node]\nname = \"{name}\"\naddress = \"127.0.0.{}\"\nproject = \"healthy\"\n\
             [ndl]\nmulticast = \"{}\"\nmdns_port = false\n",
            nth + 1,
            self.group
        );
        std::fs::write(&path, text).expect("the test's own directory");
        node_under_test(None, &path, &["--logs"])
    }

    /// Each of these has found all others.
    fn all_meet(&self, nodes: &mut [Program]) {
        for (nth, node) in nodes.iter_mut().enumerate() {
            for other in (0..self.count).filter(|other| *other != nth) {
                node.wait_for(&["NodeFound", &format!("\"{}\"", NAMES[other])]);
            }
        }
    }
}

/// Ends a node in order. Nothing that it has said is a warning.
fn stop(mut node: Program) {
    node.signal(Signal::TERM);
    assert_eq!(node.wait_for_end(), Some(0));
    is_calm(&node);
}

fn is_calm(node: &Program) {
    let warnings: Vec<_> =
        node.said().iter().filter(|line| line.contains(" WARN ") || line.contains("ERROR")).collect();
    assert!(warnings.is_empty(), "{warnings:#?}");
}

#[test]
fn nodes_that_start_at_once_and_stop_in_either_order_warn_of_nothing() {
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
fn nodes_that_start_one_after_the_other_and_stop_at_once_warn_of_nothing() {
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
        assert_eq!(node.wait_for_end(), Some(0));
        is_calm(&node);
    }
}

#[test]
fn a_node_that_is_stopped_and_started_again_has_nobody_warn() {
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
            // Its next life.
            node.wait_for(&["event Node", "\"a\""]);
        }
        nodes.insert(0, again);
    }
    nodes.into_iter().for_each(stop);
}
