//! A host that stands still for a while: nobody's fault, and no reason to kill a process that is healthy.

use std::{net::UdpSocket, time::Duration};

use rustix::process::Signal;
use sinew::{NodeApi, Registration};
use sinew_tests::{
    DEADLINE, OwnDirectory, Program,
    orders::{Me, Order, Who},
    process_under_test, wait_until_frozen,
};

use crate::scenario::{Scenario, Watched, configuration, signal};

/// Longer than an application has for a turn, to start, or to stop.
const STALL: Duration = Duration::from_millis(6_500);

/// Nothing of the node and of its process runs for a while, or nothing of the node.
fn stall(node: &Program, process: Option<u32>) {
    process.into_iter().for_each(|id| signal(id, Signal::STOP));
    node.freeze();
    process.into_iter().for_each(wait_until_frozen);
    std::thread::sleep(STALL);
    node.signal(Signal::CONT);
    process.into_iter().for_each(|id| signal(id, Signal::CONT));
}

/// Which process says that it has started.
fn started(node: &mut Program) -> u32 {
    let line = node.wait_for(&["started"]);
    line.split(' ').next().and_then(|id| id.parse().ok()).expect("it begins with its id")
}

#[test]
fn a_host_that_stands_still_kills_no_process_of_a_node() {
    let mut scenario = Scenario::start(&[]);
    let pid = scenario.who().pid;
    for _ in 0..3 {
        stall(&scenario.node, Some(pid));
        assert_eq!(scenario.who().pid, pid);
    }
}

#[test]
fn a_process_that_starts_while_its_node_or_all_of_the_host_stands_still_is_not_killed() {
    for with_process in [false, true] {
        let directory = OwnDirectory::new();
        let mut node = process_under_test(
            &configuration(&directory, ""),
            &["--starts-in", "500", "--starts-within", "6000"],
        );
        let pid = started(&mut node);
        stall(&node, with_process.then_some(pid));
        node.wait_for(&["is up"]);
        let api = NodeApi::connect(directory.join("robot.sock")).expect("the node is up");
        let wanted = Registration::new().requires(["drive"]).deadline(DEADLINE);
        let mut endpoint = api.register_transport_address(wanted).expect("the drive becomes ready");
        let drive = endpoint.resolve("drive", DEADLINE).expect("the node answers").expect("it is ready");
        let me: Me = endpoint.message(drive, &Who {}).ask(DEADLINE).expect("it answers");
        assert_eq!(me.pid, pid, "with the process: {with_process}");
    }
}

#[test]
fn a_process_that_stops_while_its_node_or_all_of_the_host_stands_still_has_its_time() {
    for with_process in [false, true] {
        let mut scenario = Scenario::start(&["--ramps-for", "300", "--stops-within", "6000"]);
        let pid = scenario.who().pid;
        let process = Watched::new(pid);
        scenario.node.signal(Signal::TERM);
        scenario.node.wait_for(&["ramping down"]);
        if with_process {
            stall(&scenario.node, Some(pid));
        } else {
            // Its ramp is over meanwhile, and it says so to a node that cannot hear it.
            stall(&scenario.node, None);
        }
        scenario.node.wait_for(&[&format!("{pid} stopping")]);
        process.wait_for_end();
        assert_eq!(scenario.node.wait_for_end(), Some(0));
        let killed = scenario.node.said().iter().find(|line| line.contains("its life is taken"));
        assert_eq!(killed, None);
    }
}

#[test]
fn a_process_that_hangs_in_started_or_in_its_factory_is_noticed_as_a_thread_is() {
    for place in ["started", "factory"] {
        for lives_in in ["thread", "process"] {
            let directory = OwnDirectory::new();
            let token = directory.join("token");
            std::fs::write(&token, "").expect("the test's own directory");
            let token = token.to_str().expect("it is text");
            let arguments = ["--place", lives_in, "--hangs-in", place, token];
            let mut node = process_under_test(&configuration(&directory, ""), &arguments);
            node.wait_for(&[&format!("hangs in its {place}")]);
            let line = node.wait_for(&["a child failed"]);
            assert!(line.contains("hung: in its `started`"), "{place}, in a {lives_in}: {line}");
            let api = NodeApi::connect(directory.join("robot.sock")).expect("the node is up");
            let wanted = Registration::new().requires(["drive"]).deadline(DEADLINE);
            api.register_transport_address(wanted).expect("the next life of it becomes ready");
        }
    }
}

#[test]
fn a_process_that_starts_for_longer_than_a_turn_may_last_is_not_killed_as_long_as_it_comes_back() {
    // Its turns have a second each.
    let mut scenario = Scenario::start(&["--starts-in", "2500", "--starts-within", "60000"]);
    assert_eq!(scenario.who().pid, started(&mut scenario.node));
}

#[test]
fn an_application_that_stalls_in_its_process_is_named_to_other_nodes_until_its_next_life() {
    // Given: a node with an application in a process, and another node, whose application says what it hears.
    let free = UdpSocket::bind("127.0.0.1:0").expect("a port on loopback").local_addr().expect("it is bound");
    // Quick, and with time for a machine that stands still for a moment.
    let more = format!("period_ms = 250\nmissed_max = 40\nport = {}\n", free.port());
    let mut scenario = Scenario::start_with(&more, &["--turns-within", "600000"]);
    let directory = OwnDirectory::new();
    let path = directory.join("watcher.toml");
    let text = format!(
        "[node]\nname = \"watcher\"\naddress = \"127.0.0.2\"\nproject = \"processes\"\n\
         [ndl]\nmulticast = false\nmdns_port = false\nperiod_ms = 250\nmissed_max = 40\nseeds = [\"{free}\"]\n"
    );
    std::fs::write(&path, text).expect("the test's own directory");
    let mut watcher = process_under_test(&path, &["--place", "thread"]);
    watcher.wait_for(&["event NodeFound", "robot"]);
    let pid = scenario.who().pid;
    // When
    scenario.order(Order::Hang);
    // Then
    watcher.wait_for(&["event AppStalled", "robot", "drive", "Stalled"]);
    // When: its next life is well
    signal(pid, Signal::KILL);
    // Then
    watcher.wait_for(&["event AppResumed", "robot", "drive"]);
    assert_ne!(scenario.who().pid, pid);
    assert!(watcher.said().iter().all(|line| !line.contains("NodeLost")), "{:?}", watcher.said());
}
