//! A host that stalls for a while: no process is at fault, and a healthy process is not killed.

use std::{net::UdpSocket, thread, time::Duration};

use rustix::process::Signal;
use sinew::{NodeApi, Registration};
use sinew_testkit::{DEADLINE, NodeProcess, TestDirectory, wait_until_paused};
use sinew_tests::{
    orders::{Me, Order, Who},
    process_under_test,
};

use super::scenario::{Scenario, Watched, configuration, signal};

/// Longer than an application has for a turn, to start, or to stop.
const STALL: Duration = Duration::from_millis(6_500);

/// Stalls the node and its process for a while, or only the node.
fn stall(node: &NodeProcess, process: Option<u32>) {
    process.into_iter().for_each(|id| signal(id, Signal::STOP));
    node.pause();
    process.into_iter().for_each(wait_until_paused);
    thread::sleep(STALL);
    node.signal(Signal::CONT);
    process.into_iter().for_each(|id| signal(id, Signal::CONT));
}

/// Runs a claim for each case at the same time: the cases wait, each on a node of its own.
fn at_once<C: Send>(cases: impl IntoIterator<Item = C>, claim: impl Fn(C) + Sync) {
    let claim = &claim;
    thread::scope(|scope| {
        for case in cases {
            scope.spawn(move || claim(case));
        }
    });
}

/// The ID of the process that reports its start.
fn started(node: &mut NodeProcess) -> u32 {
    let line = node.wait_for(&["started"]);
    line.split(' ').next().and_then(|id| id.parse().ok()).expect("it begins with its id")
}

#[test]
fn stalled_host_kills_no_process_of_a_node() {
    let mut scenario = Scenario::start(&[]);
    let pid = scenario.who().pid;
    for _ in 0..3 {
        stall(&scenario.node, Some(pid));
        assert_eq!(scenario.who().pid, pid);
    }
}

#[test]
fn process_that_starts_during_a_stall_is_not_killed() {
    at_once([false, true], |with_process| {
        let directory = TestDirectory::new();
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
    });
}

#[test]
fn process_that_stops_during_a_stall_has_its_time() {
    at_once([false, true], |with_process| {
        let mut scenario = Scenario::start(&["--ramps-for", "300", "--stops-within", "6000"]);
        let pid = scenario.who().pid;
        let process = Watched::new(pid);
        scenario.node.signal(Signal::TERM);
        scenario.node.wait_for(&["ramping down"]);
        if with_process {
            stall(&scenario.node, Some(pid));
        } else {
            // Its ramp ends meanwhile, and it reports this to a node that cannot read it.
            stall(&scenario.node, None);
        }
        scenario.node.wait_for(&[&format!("{pid} stopping")]);
        process.wait_for_end();
        assert_eq!(scenario.node.wait_for_exit(), Some(0));
        let killed = scenario.node.output().iter().find(|line| line.contains("the incarnation is abandoned"));
        assert_eq!(killed, None);
    });
}

#[test]
fn hang_at_the_start_of_a_process_is_noticed() {
    let places = ["started", "factory"];
    let cases = places.into_iter().flat_map(|place| ["thread", "process"].map(|lives_in| (place, lives_in)));
    at_once(cases, |(place, lives_in)| {
        let directory = TestDirectory::new();
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
        api.register_transport_address(wanted).expect("its next incarnation becomes ready");
    });
}

#[test]
fn long_start_in_short_turns_is_not_killed() {
    // Its turns have a second each.
    let mut scenario = Scenario::start(&["--starts-in", "2500", "--starts-within", "60000"]);
    assert_eq!(scenario.who().pid, started(&mut scenario.node));
}

#[test]
fn stalled_app_in_a_process_is_named_remotely() {
    // Given: a node with an application in a process, and another node with an application that reports its
    // events
    let free = UdpSocket::bind("127.0.0.1:0").expect("a port on loopback").local_addr().expect("it is bound");
    // Short, and with a margin for a machine that stalls for a moment.
    let more = format!("period_ms = 250\nmissed_max = 40\nport = {}\n", free.port());
    let mut scenario = Scenario::start_with(&more, &["--turns-within", "600000"]);
    let directory = TestDirectory::new();
    let text = format!(
        "[node]\nname = \"watcher\"\naddress = \"127.0.0.2\"\nproject = \"processes\"\n\
         [ndl]\nmulticast = false\nmdns_port = false\nperiod_ms = 250\nmissed_max = 40\nseeds = [\"{free}\"]\n"
    );
    let path = directory.write("watcher.toml", &text);
    let mut watcher = process_under_test(&path, &["--place", "thread"]);
    watcher.wait_for(&["event NodeFound", "robot"]);
    let pid = scenario.who().pid;
    // When
    scenario.order(Order::Hang);
    // Then
    watcher.wait_for(&["event AppStalled", "robot", "drive", "Stalled"]);
    // When: its next incarnation works normally
    signal(pid, Signal::KILL);
    // Then
    watcher.wait_for(&["event AppResumed", "robot", "drive"]);
    assert_ne!(scenario.who().pid, pid);
    assert!(watcher.output().iter().all(|line| !line.contains("NodeLost")), "{:?}", watcher.output());
}
