//! Nodes as processes: killed, frozen, resumed, and given faults from outside by `SINEW_FAULTS`.

use sinew_tests::role;
use std::{net::SocketAddrV4, path::PathBuf};

use rustix::process::Signal;
use sinew::{NodeApi, Registration, prelude::*};
use sinew_testkit::{
    DEADLINE, Loopback, NodeProcess, TestDirectory, all_run,
    scripted::{Script, Seen, sender_app},
    until,
};
use sinew_tests::{
    node_under_test,
    orders::{Count, Me, Who},
};

/// Processes of one scenario, and the network that a node of this process may share with them.
struct Scenario {
    loopback: Loopback,
    directory: TestDirectory,
}

impl Scenario {
    fn new() -> Self {
        Self { loopback: Loopback::new(), directory: TestDirectory::new() }
    }

    /// All limits are long. A machine that stalls for a moment loses no node, and a process that fails at
    /// once fails too often, however long each incarnation takes. Addresses start at 101: those from 1 up
    /// belong to the test's own network.
    fn configuration(&self, name: &str, address: u8, more: &str) -> PathBuf {
        let group: SocketAddrV4 = self.loopback.group;
        let text = format!(
            "[node]\nname = \"{name}\"\naddress = \"127.0.0.{address}\"\n\
             [ndl]\nmulticast = \"{group}\"\nmdns_port = false\nmissed_max = 40\n\
             [supervision]\napp_window_ms = 3600000\n{more}"
        );
        self.directory.write(&format!("{name}.toml"), &text)
    }

    fn start(&self, name: &str, address: u8, arguments: &[&str]) -> NodeProcess {
        node_under_test(None, &self.configuration(name, address, ""), arguments)
    }

    fn start_with(&self, faults: &str, name: &str, address: u8, arguments: &[&str]) -> NodeProcess {
        let mut command = role("node_under_test");
        command
            .arg(self.configuration(name, address, ""))
            .args(arguments)
            .env("SINEW_FAULTS", faults)
            .env("RUST_BACKTRACE", "0");
        NodeProcess::start(name, command)
    }
}

#[test]
fn environment_fault_panics_app_and_messages_continue() {
    let scenario = Scenario::new();
    let mut knee = scenario.start_with("knee:panic@5, nobody.here:stop@1", "knee", 101, &[]);
    let mut hip = scenario.start("hip", 102, &["--requires", "knee", "--sends-to", "knee"]);
    hip.wait_for(&["started"]);
    knee.wait_for(&["count 12 from"]);
    // Node events are counted as well, so the fault strikes one of the first five numbers.
    let counted =
        |number: &u64| knee.output().iter().any(|line| line.starts_with(&format!("count {number} ")));
    let missing: Vec<_> = (1..=12).filter(|number| !counted(number)).collect();
    assert!(matches!(*missing, [1..=5]), "{missing:?}");
}

#[test]
fn unreadable_environment_plan_fails_the_start_with_reason() {
    let scenario = Scenario::new();
    let mut knee = scenario.start_with("knee:panik@5", "knee", 101, &[]);
    knee.wait_for(&["refused", "`panik` is nothing that can happen", "write panic"]);
    assert_eq!(knee.wait_for_exit(), Some(1));
}

#[test]
fn layers_struck_from_outside_return_without_node_loss() {
    let scenario = Scenario::new();
    let mut knee = scenario.start_with("NDL:panic@1, sync:panic@2, GNCL:panic@1", "knee", 101, &[]);
    let mut hip = scenario.start("hip", 102, &["--requires", "knee", "--sends-to", "knee"]);
    hip.wait_for(&["started"]);
    knee.wait_for(&["count"]);
    assert!(hip.output().iter().all(|line| !line.contains("NodeLost")), "{:?}", hip.output());
}

#[test]
fn app_that_fails_too_often_ends_its_process() {
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 102, &["--sends-to", "knee"]);
    hip.wait_for(&["started"]);
    let mut knee = scenario.start_with("knee:panic@every(1)", "knee", 101, &[]);
    assert_eq!(knee.wait_for_exit(), Some(1));
    hip.wait_for(&["NodeLost", "knee", "GaveUp"]);
}

#[test]
fn killed_process_leaves_no_message_without_outcome() {
    let scenario = Scenario::new();
    let knee = scenario.start("knee", 101, &[]);
    let (sender_app, key) = sender_app("sender");
    let here = scenario.loopback.node("home").app(sender_app).start().expect("a node");
    let sender = key.sender();
    let tid = until("the knee is known", || sender.resolve("knee"));
    let payload = || sinew_testkit::scripted::Order { number: 1 };
    until("it is reached", || sender.send(tid, &payload()).ok());
    // Frozen: messages that are sent now cannot be answered any more.
    knee.pause();
    let sent: Vec<_> =
        (0..100).filter_map(|_| sender.message(tid, &payload()).confirmed(DEADLINE).ok()).collect();
    assert!(!sent.is_empty());
    knee.signal(Signal::KILL);
    let outcomes = sinew_testkit::scripted::wait(async {
        let mut outcomes = Vec::new();
        for confirmation in sent {
            outcomes.push(confirmation.await);
        }
        outcomes
    });
    assert!(
        outcomes.iter().all(|outcome| matches!(outcome, Outcome::Unknown | Outcome::PeerLost)),
        "no node was there to report anything else: {outcomes:?}"
    );
    drop(here);
}

#[test]
fn briefly_frozen_process_is_not_lost_and_keeps_order() {
    let scenario = Scenario::new();
    let mut knee = scenario.start("knee", 101, &[]);
    let mut hip = scenario.start("hip", 102, &["--requires", "knee", "--sends-to", "knee"]);
    knee.wait_for(&["count 1 from"]);
    knee.pause();
    // Until one query was missed, but fewer than make a loss: the hip keeps sending meanwhile.
    hip.wait_for(&["started"]);
    std::thread::sleep(Duration::from_millis(300)); // the length of the freeze, not a wait for an event
    knee.signal(Signal::CONT);
    for number in 2..=40 {
        knee.wait_for(&[&format!("count {number} from"), &format!("after {}", number - 1)]);
    }
    assert!(hip.output().iter().all(|line| !line.contains("NodeLost")), "{:?}", hip.output());
}

#[test]
fn node_killed_at_the_barrier_is_awaited_again() {
    let scenario = Scenario::new();
    let (scripted, log) = Script::new().app("scripted");
    let here =
        scenario.loopback.node("home").app(scripted.requires(["knee", "hip"])).start().expect("a node");
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
fn killed_process_rejoins_and_its_messages_flow() {
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
fn stop_order_with_a_slow_application_stops_cleanly() {
    let scenario = Scenario::new();
    let mut knee = scenario.start_with("knee:slow(20ms)@every(1)", "knee", 101, &[]);
    let mut hip = scenario.start("hip", 102, &["--requires", "knee", "--sends-to", "knee"]);
    hip.wait_for(&["started"]);
    knee.wait_for(&["count 3 from"]);
    knee.signal(Signal::TERM);
    knee.wait_for(&["stopping"]);
    assert_eq!(knee.wait_for_exit(), Some(0));
    hip.wait_for(&["NodeLost", "knee", "Left"]);
}

#[test]
fn app_in_own_process_takes_its_faults_along() {
    let scenario = Scenario::new();
    let socket = scenario.directory.join("robot.sock");
    let more = format!("[lncl]\nsocket = \"{}\"\n", socket.display());
    let mut command = role("process_under_test");
    command
        .arg(scenario.configuration("robot", 101, &more))
        .env("SINEW_FAULTS", "drive:panic@3")
        .env("RUST_BACKTRACE", "0");
    let mut robot = NodeProcess::start("robot", command);
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
fn either_end_of_a_conversation_may_be_killed() {
    let scenario = Scenario::new();
    let (scripted, log) = Script::new().app("scripted");
    let here = scenario.loopback.node("home").app(scripted.handles::<NodeEvent>()).start().expect("a node");
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
