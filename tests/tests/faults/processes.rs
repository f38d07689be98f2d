//! Nodes as processes: killed, frozen, thawed, and struck from outside by `SINEW_FAULTS`.

use std::{net::SocketAddrV4, path::PathBuf, process::Command};

use rustix::process::Signal;
use sinew::{NodeApi, Registration, prelude::*};
use sinew_tests::{
    DEADLINE, Ground, OwnDirectory, Program, all_run, node_under_test,
    orders::{Count, Me, Who},
    program,
    puppet::{Seen, Stage, desk},
    until,
};

/// Processes of one scenario, and the network that a node of this process may share with them.
struct Scenario {
    ground: Ground,
    directory: OwnDirectory,
}

impl Scenario {
    fn new() -> Self {
        Self { ground: Ground::new(), directory: OwnDirectory::new() }
    }

    /// With a long time for everything: a machine that stands still for a moment loses nobody, and a process that fails at once fails too often
    /// however long each life takes. Addresses from 101 up: those from 1 up are the ground's own.
    fn configuration(&self, name: &str, address: u8, more: &str) -> PathBuf {
        let path = self.directory.join(&format!("{name}.toml"));
        let group: SocketAddrV4 = self.ground.group;
        let text = format!(
            "[node]\nname = \"{name}\"\naddress = \"127.0.0.{address}\"\n\
             [ndl]\nmulticast = \"{group}\"\nmdns_port = false\nmissed_max = 40\n\
             [supervision]\napp_window_ms = 3600000\n{more}"
        );
        std::fs::write(&path, text).expect("the test's own directory");
        path
    }

    fn start(&self, name: &str, address: u8, arguments: &[&str]) -> Program {
        node_under_test(None, &self.configuration(name, address, ""), arguments)
    }

    fn start_with(&self, faults: &str, name: &str, address: u8, arguments: &[&str]) -> Program {
        let mut command = Command::new(program("node_under_test"));
        command
            .arg(self.configuration(name, address, ""))
            .args(arguments)
            .env("SINEW_FAULTS", faults)
            .env("RUST_BACKTRACE", "0");
        Program::start(name, command)
    }
}

#[test]
fn the_environment_lets_an_application_of_a_process_panic_and_its_messages_go_on() {
    let scenario = Scenario::new();
    let mut knee = scenario.start_with("knee:panic@5, nobody.here:stop@1", "knee", 101, &[]);
    let mut hip = scenario.start("hip", 102, &["--requires", "knee", "--sends-to", "knee"]);
    hip.wait_for(&["started"]);
    knee.wait_for(&["count 12 from"]);
    // What it hears of nodes counts as well, so that it is one of the first five numbers that is in its hand.
    let counted = |number: &u64| knee.said().iter().any(|line| line.starts_with(&format!("count {number} ")));
    let missing: Vec<_> = (1..=12).filter(|number| !counted(number)).collect();
    assert!(matches!(*missing, [1..=5]), "{missing:?}");
}

#[test]
fn a_plan_of_the_environment_that_cannot_be_read_fails_the_start_in_words() {
    let scenario = Scenario::new();
    let mut knee = scenario.start_with("knee:panik@5", "knee", 101, &[]);
    knee.wait_for(&["refused", "`panik` is nothing that can happen", "write panic"]);
    assert_eq!(knee.wait_for_end(), Some(1));
}

#[test]
fn layers_of_a_process_that_are_struck_from_outside_come_back_and_the_nodes_stay_together() {
    let scenario = Scenario::new();
    let mut knee = scenario.start_with("NDL:panic@1, sync:panic@2, GNCL:panic@1", "knee", 101, &[]);
    let mut hip = scenario.start("hip", 102, &["--requires", "knee", "--sends-to", "knee"]);
    hip.wait_for(&["started"]);
    knee.wait_for(&["count"]);
    assert!(hip.said().iter().all(|line| !line.contains("NodeLost")), "{:?}", hip.said());
}

#[test]
fn an_application_that_fails_too_often_ends_its_process_with_code_1_and_the_others_are_told() {
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 102, &["--sends-to", "knee"]);
    hip.wait_for(&["started"]);
    let mut knee = scenario.start_with("knee:panic@every(1)", "knee", 101, &[]);
    assert_eq!(knee.wait_for_end(), Some(1));
    hip.wait_for(&["NodeLost", "knee", "GaveUp"]);
}

#[test]
fn a_process_killed_under_confirmed_traffic_leaves_no_message_without_an_outcome() {
    let scenario = Scenario::new();
    let knee = scenario.start("knee", 101, &[]);
    let (desk, key) = desk("desk");
    let here = scenario.ground.node("home").app(desk).start().expect("a node");
    let sender = key.sender();
    let tid = until("the knee is known", || sender.resolve("knee"));
    let payload = || sinew_tests::puppet::Order { number: 1 };
    until("it is reached", || sender.send(tid, &payload()).ok());
    // Frozen: what is sent now cannot be answered any more.
    knee.freeze();
    let sent: Vec<_> =
        (0..100).filter_map(|_| sender.message(tid, &payload()).confirmed(DEADLINE).ok()).collect();
    assert!(!sent.is_empty());
    knee.signal(Signal::KILL);
    let outcomes = sinew_tests::puppet::wait(async {
        let mut outcomes = Vec::new();
        for confirmation in sent {
            outcomes.push(confirmation.await);
        }
        outcomes
    });
    assert!(
        outcomes.iter().all(|outcome| matches!(outcome, Outcome::Unknown | Outcome::PeerLost)),
        "nobody was there to say anything else: {outcomes:?}"
    );
    drop(here);
}

#[test]
fn a_process_that_freezes_for_a_moment_is_not_lost_and_gets_every_message_in_order() {
    let scenario = Scenario::new();
    let mut knee = scenario.start("knee", 101, &[]);
    let mut hip = scenario.start("hip", 102, &["--requires", "knee", "--sends-to", "knee"]);
    knee.wait_for(&["count 1 from"]);
    knee.freeze();
    // Until a query was missed, but fewer than make a loss: the hip goes on sending all the while.
    hip.wait_for(&["started"]);
    std::thread::sleep(Duration::from_millis(300)); // the length of the freeze, not a wait for anything
    knee.signal(Signal::CONT);
    for number in 2..=40 {
        knee.wait_for(&[&format!("count {number} from"), &format!("after {}", number - 1)]);
    }
    assert!(hip.said().iter().all(|line| !line.contains("NodeLost")), "{:?}", hip.said());
}

#[test]
fn a_node_killed_while_others_wait_for_it_at_the_barrier_is_waited_for_in_its_next_life() {
    let scenario = Scenario::new();
    let (puppet, log) = Stage::new().app("puppet");
    let here = scenario.ground.node("home").app(puppet.requires(["knee", "hip"])).start().expect("a node");
    let mut knee = scenario.start("knee", 101, &[]);
    knee.wait_for(&["started"]);
    until("half of the barrier is met", || here.handle().resolve("knee"));
    knee.signal(Signal::KILL);
    drop(knee);
    let mut hip = scenario.start("hip", 102, &[]);
    hip.wait_for(&["started"]);
    until("the other half is met", || here.handle().resolve("hip"));
    until("the first half is lost again", || {
        let waiting = here.handle().waiting();
        waiting.iter().any(|waiting| waiting.to_string().contains("for knee")).then_some(())
    });
    assert_eq!(log.all(), [], "it was not let through");
    let _knee = scenario.start("knee", 101, &[]);
    all_run(&[&here]);
    assert_eq!(log.all(), [Seen::Made(1), Seen::Started(1)]);
}

#[test]
fn a_killed_process_is_let_in_again_and_its_messages_flow_in_its_next_life() {
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 102, &["--sends-to", "knee"]);
    hip.wait_for(&["started"]);
    for _ in 0..2 {
        let mut knee = scenario.start("knee", 101, &[]);
        knee.wait_for(&["count", "from 127.0.0.102", "after 0"]);
        knee.signal(Signal::KILL);
        hip.wait_for(&["NodeLost", "knee"]);
    }
}

#[test]
fn a_process_that_is_told_to_stop_while_its_application_is_slow_stops_in_order() {
    let scenario = Scenario::new();
    let mut knee = scenario.start_with("knee:slow(20ms)@every(1)", "knee", 101, &[]);
    let mut hip = scenario.start("hip", 102, &["--requires", "knee", "--sends-to", "knee"]);
    hip.wait_for(&["started"]);
    knee.wait_for(&["count 3 from"]);
    knee.signal(Signal::TERM);
    knee.wait_for(&["stopping"]);
    assert_eq!(knee.wait_for_end(), Some(0));
    hip.wait_for(&["NodeLost", "knee", "Left"]);
}

#[test]
fn an_application_in_a_process_of_its_own_takes_its_faults_along() {
    let scenario = Scenario::new();
    let socket = scenario.directory.join("robot.sock");
    let more = format!("[lncl]\nsocket = \"{}\"\n", socket.display());
    let mut command = Command::new(program("process_under_test"));
    command
        .arg(scenario.configuration("robot", 101, &more))
        .env("SINEW_FAULTS", "drive:panic@3")
        .env("RUST_BACKTRACE", "0");
    let mut robot = Program::start("robot", command);
    robot.wait_for(&["up"]);
    let api = NodeApi::connect(&socket).expect("the node is up");
    let wanted = Registration::new().name("test").requires(["drive"]).deadline(DEADLINE);
    let mut endpoint = api.register_transport_address(wanted).expect("the drive becomes ready");
    let drive = endpoint.resolve("drive", DEADLINE).expect("the node answers").expect("it is ready");
    let mut who = || -> Me { endpoint.message(drive, &Who {}).ask(DEADLINE).expect("the drive answers") };
    let first = who();
    assert_ne!(first.pid, robot.id());
    assert_eq!(who().pid, first.pid);
    let failed = endpoint.message(drive, &Count { number: 3 }).confirmed(DEADLINE).expect("the node answers");
    assert_eq!(failed, Outcome::Failed, "the third message of this process");
    let next: Me = endpoint.message(drive, &Who {}).ask(DEADLINE).expect("the drive answers");
    assert!(next.pid != first.pid && next.pid != robot.id(), "a new process: {next:?}");
}

#[test]
fn both_ends_of_a_conversation_may_be_killed_in_turn() {
    let scenario = Scenario::new();
    let (puppet, log) = Stage::new().app("puppet");
    let here = scenario.ground.node("home").app(puppet.handles::<NodeEvent>()).start().expect("a node");
    all_run(&[&here]);
    for (round, address) in [(1, 101), (2, 102), (3, 101)] {
        let name = format!("peer{address}");
        let mut peer = scenario.start(&name, address, &[]);
        peer.wait_for(&["NodeFound", "home"]);
        let there = NodeAddress::from([127, 0, 0, address]);
        log.wait("the peer is seen", |seen| {
            let found = |seen: &&Seen| matches!(seen, Seen::Node(NodeEvent::NodeFound { node, .. } | NodeEvent::NodeRestarted { node, .. }) if *node == there);
            (seen.iter().filter(found).count() > usize::from(round == 3)).then_some(())
        });
        peer.signal(Signal::KILL);
        until("it is lost", || here.handle().members().is_empty().then_some(()));
    }
}
