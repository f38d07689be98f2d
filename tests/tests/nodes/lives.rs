//! Whole nodes on this host: found, killed, restarted, stopped in order, misconfigured.

use sinew_testkit::sandbox::after_shell;
use sinew_tests::role;
use std::{
    net::{SocketAddrV4, TcpListener},
    path::PathBuf,
    time::{Duration, Instant},
};

use rustix::process::Signal;
use sinew::{NodeApi, Registration, StartError, address::Incarnation, node::NodeEnd};
use sinew_testkit::{Loopback, NodeProcess, TestDirectory, all_run, own_group};
use sinew_tests::{node_under_test, process_under_test};

/// Interval of the messages of a node with a sender.
const SENT_EVERY: Duration = Duration::from_millis(20);

/// Incarnations of the node that a destructor stops: a lost wake is a race, which a single one may win.
const ENDS_OF_PROCESSES: u32 = 30;

/// Nodes of a scenario: each with its own address on loopback, in the scenario's own multicast group.
struct Scenario {
    directory: TestDirectory,
    group: SocketAddrV4,
}

impl Scenario {
    fn new() -> Self {
        Self { directory: TestDirectory::new(), group: own_group() }
    }

    fn configuration(&self, name: &str, address: u8) -> PathBuf {
        let text = format!(
            "[node]\nname = \"{name}\"\naddress = \"127.0.0.{address}\"\nproject = \"nodes\"\n\
             [ndl]\nmulticast = \"{}\"\nmdns_port = false\n",
            self.group
        );
        self.directory.write(&format!("{name}.toml"), &text)
    }

    fn start(&self, name: &str, address: u8, more: &[&str]) -> NodeProcess {
        node_under_test(None, &self.configuration(name, address), more)
    }
}

#[test]
fn app_waits_for_a_remote_app() {
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &["--requires", "knee", "--sends-to", "knee"]);
    hip.wait_for(&["up"]);
    let mut knee = scenario.start("knee", 2, &[]);
    hip.wait_for(&["started"]);
    for number in 1..=20 {
        knee.wait_for(&[&format!("count {number} from 127.0.0.1"), &format!("after {}", number - 1)]);
    }
}

#[test]
fn killed_node_is_lost_at_once_and_restarts() {
    let scenario = Scenario::new();
    // Its start proves that the two are connected.
    let mut hip = scenario.start("hip", 1, &["--requires", "knee"]);
    let knee = scenario.start("knee", 2, &[]);
    hip.wait_for(&["started"]);
    knee.signal(Signal::KILL);
    hip.wait_for(&["NodeLost", "knee", "Crashed"]);
    let mut knee = scenario.start("knee", 2, &[]);
    hip.wait_for(&["NodeRestarted", "knee"]);
    knee.wait_for(&["NodeFound", "hip"]);
}

/// Whether this process ignores SIGHUP, as under `nohup`, and so each node that it starts (proc(5), `SigIgn`).
fn ignores_hangups() -> bool {
    let status = std::fs::read_to_string("/proc/self/status").expect("the system describes this process");
    let mask = status.lines().find_map(|line| line.strip_prefix("SigIgn:")).expect("signals are described");
    u64::from_str_radix(mask.trim(), 16).expect("a mask in hexadecimal") & 1 != 0
}

#[test]
fn stopped_node_notifies_its_app_and_sends_goodbye() {
    for signal in [Signal::TERM, Signal::INT, Signal::HUP] {
        if signal == Signal::HUP && ignores_hangups() {
            println!("not tested: this process ignores SIGHUP, and nodes inherit that");
            continue;
        }
        let scenario = Scenario::new();
        let mut hip = scenario.start("hip", 1, &[]);
        let mut knee = scenario.start("knee", 2, &[]);
        hip.wait_for(&["NodeFound", "knee"]);
        knee.wait_for(&["started"]);
        knee.signal(signal);
        knee.wait_for(&["stopping"]);
        assert_eq!(knee.wait_for_exit(), Some(0));
        hip.wait_for(&["NodeLost", "knee", "Left"]);
    }
}

#[test]
fn node_with_ignored_hangups_survives_a_hangup() {
    let scenario = Scenario::new();
    let mut command = role("node_under_test");
    command.arg(scenario.configuration("knee", 2)).args(["--says-directory", "--requires", "hip"]);
    let mut knee = NodeProcess::start("knee", after_shell(r#"trap "" HUP"#, &command));
    knee.wait_for(&["up"]);
    knee.signal(Signal::HUP);
    // It finds and starts nodes that come later.
    let _hip = scenario.start("hip", 1, &[]);
    knee.wait_for(&["started"]);
    knee.signal(Signal::TERM);
    assert_eq!(knee.wait_for_exit(), Some(0));
}

/// The destructor that stops the node runs after those of the thread-local variables of tokio and of the log.
#[test]
fn node_stopped_by_a_destructor_at_exit_stops_cleanly() {
    let scenario = Scenario::new();
    for incarnation in 0..ENDS_OF_PROCESSES {
        let mut knee = scenario.start("knee", 2, &["--held"]);
        let code = knee.wait_for_exit();
        assert_eq!(code, Some(3), "incarnation {incarnation}: {:?}", knee.output());
        assert!(
            knee.output().iter().any(|line| line.contains("stopping")),
            "incarnation {incarnation}: {:?}",
            knee.output()
        );
    }
}

#[test]
fn frozen_node_is_lost_and_found_again() {
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &[]);
    let mut knee = scenario.start("knee", 2, &[]);
    hip.wait_for(&["NodeFound", "knee"]);
    knee.wait_for(&["NodeFound", "hip"]);
    knee.pause();
    hip.wait_for(&["NodeLost", "knee", "Hung"]);
    knee.signal(Signal::CONT);
    hip.wait_for(&["NodeFound", "knee"]);
}

#[test]
fn wrong_configuration_is_rejected_with_all_its_faults() {
    let scenario = Scenario::new();
    let path = scenario.directory.join("wrong.toml");
    std::fs::write(&path, "[node]\nname = \"\"\n[ndl]\nperiod_ms = 1\ncolour = \"red\"\n")
        .expect("own directory");
    let mut wrong = node_under_test(None, &path, &[]);
    assert_eq!(wrong.wait_for_exit(), Some(1));
    let text = wrong.output().join("\n");
    for fault in ["node.name", "ndl.period_ms", "ndl.colour"] {
        assert!(text.contains(fault), "{fault} is not in:\n{text}");
    }
}

#[test]
fn second_node_with_the_same_address_is_rejected() {
    // Given: two nodes, one of which sends to the other
    let (scenario, began) = (Scenario::new(), Instant::now());
    let mut hip = scenario.start("hip", 1, &["--requires", "knee", "--sends-to", "knee"]);
    let mut knee = scenario.start("knee", 2, &[]);
    knee.wait_for(&["count 1 ", "from 127.0.0.1"]);
    // When: another node claims the address of the second, and then a new node meets all of them
    let mut impostor = scenario.start("impostor", 2, &[]);
    let mut ankle = scenario.start("ankle", 3, &["--requires", "hip", "--sends-to", "hip"]);
    ankle.wait_for(&["started"]);
    hip.wait_for(&["count", "from 127.0.0.3"]);
    // Then: whichever of the two the new node accepts, the two original nodes continue
    let not_sent_yet = began.elapsed().as_millis() / SENT_EVERY.as_millis() + 1;
    knee.wait_for(&[&format!("count {not_sent_yet} "), "from 127.0.0.1"]);
    assert!(hip.output().iter().all(|line| !line.contains("impostor")));
    // Whether it was up by then, or did not start.
    assert_eq!(impostor.wait_for_exit(), Some(1));
}

#[test]
fn later_node_with_a_used_address_fails_once() {
    // Given: a node
    let loopback = Loopback::new();
    let hip = loopback.node("hip").incarnation(Incarnation(1)).start().expect("a node");
    // When: a later incarnation with another name requests the same address
    let knee = loopback.node("knee").address(hip.address()).incarnation(Incarnation(2)).start();
    // Then: whether its layers were ready by then or not, it ends, and names the holder of the address
    let why = match knee {
        Ok(knee) => {
            let handle = knee.handle();
            let NodeEnd::GaveUp(why) = knee.wait_for_end() else { panic!("it was not asked to stop") };
            for layer in ["LNCL", "sync", "GNCL", "NDL"] {
                assert_eq!(handle.lives(layer).map(|lives| lives.starts), Some(1), "{layer}");
            }
            why
        }
        Err(StartError::AddressTaken(why)) => why,
        Err(error) => panic!("{error}"),
    };
    let [begin, end] = ["node address 127.0.0.1 is used already by 'hip' at ", ", or end the other one"];
    assert!(why.starts_with(begin) && why.ends_with(end), "{why}");
    all_run(&[&hip]);
}

#[test]
fn program_with_a_used_address_reports_only_that() {
    // Given
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &[]);
    hip.wait_for(&["up"]);
    // When
    let mut knee = process_under_test(&scenario.configuration("knee", 1), &["--place", "thread"]);
    // Then
    assert_eq!(knee.wait_for_exit(), Some(1));
    let lines = knee.output();
    let whose = "node address 127.0.0.1 is used already by 'hip' at ";
    assert!(lines.iter().any(|line| line.contains(whose)), "{lines:#?}");
    assert!(lines.iter().all(|line| !line.contains("panicked") && !line.contains("restarts")), "{lines:#?}");
}

/// Checks the lines of a program with a node that does not start because the system rejects one request.
/// Returns the only line with these words.
fn fails_once(mut node: NodeProcess, words: &str) -> String {
    assert_eq!(node.wait_for_exit(), Some(1), "{:#?}", node.output());
    let lines = node.output();
    let found: Vec<_> = lines.iter().filter(|line| line.contains(words)).collect();
    let [line] = found[..] else { panic!("{lines:#?}") };
    let is_noise =
        |line: &&String| ["panicked", " ERROR ", "no word from"].iter().any(|noise| line.contains(noise));
    let noise: Vec<_> = lines.iter().filter(is_noise).filter(|line| !line.contains(words)).collect();
    assert!(noise.is_empty(), "{noise:#?}");
    line.clone()
}

#[test]
fn used_port_fails_the_start_with_one_error() {
    let scenario = Scenario::new();
    let other = TcpListener::bind("127.0.0.1:0").expect("a free port");
    let port = other.local_addr().expect("it is bound").port();
    let config = scenario.configuration("knee", 1);
    let text = std::fs::read_to_string(&config).expect("it was written just now");
    std::fs::write(&config, format!("{text}[gncl]\nport = {port}\n")).expect("the test's own directory");
    let node = process_under_test(&config, &["--place", "thread"]);
    let line = fails_once(node, "Set `gncl.port` to a free one");
    assert!(line.contains(&port.to_string()), "{line}");
}

#[test]
fn lack_of_descriptors_fails_once_with_the_limit() {
    let scenario = Scenario::new();
    let config = scenario.configuration("knee", 1);
    // For the root, for a layer's thread, and for a later one.
    for limit in [12, 16, 24] {
        let mut command = role("process_under_test");
        command.arg(&config).args(["--place", "thread"]);
        let limited = after_shell(&format!("exec 2>&1 && ulimit -n {limit}"), &command);
        let mut node = NodeProcess::start("knee", limited);
        assert_eq!(node.wait_for_exit(), Some(1), "{limit}: {:#?}", node.output());
        let lines = node.output();
        assert!(lines.iter().all(|line| !line.contains("panicked")), "{limit}: {lines:#?}");
        assert!(lines.iter().filter(|line| line.contains(" ERROR ")).count() <= 1, "{limit}: {lines:#?}");
        assert!(lines.last().is_some_and(|line| line.contains("`ulimit -n`")), "{limit}: {lines:#?}");
    }
}

#[test]
fn used_socket_path_fails_the_start() {
    // Given: a node with a client socket.
    let (loopback, directory) = (Loopback::new(), TestDirectory::new());
    let path = directory.join("node.sock");
    let node = |name: &str| loopback.node(name).configure(|config| config.lncl.socket = Some(path.clone()));
    let knee = node("knee").start().expect("the path is free");

    // When: another node requests the same path.
    let refused = node("hip").start().expect_err("it is taken");

    // Then: the error names the remedy, and the first node continues.
    assert!(matches!(refused, StartError::Socket(_)), "{refused:?}");
    let text = refused.to_string();
    for words in ["another node listens", &path.display().to_string(), "set another `lncl.socket`"] {
        assert!(text.contains(words), "{words:?} is not in: {text}");
    }
    let api = NodeApi::connect(&path).expect("a path");
    drop(api.register_transport_address(Registration::new()).expect("the first node serves"));
    knee.stop();
    node("hip").start().expect("the path is free again");
}

#[test]
fn impossible_socket_path_fails_the_start_in_one_sentence() {
    let scenario = Scenario::new();
    let config = scenario.configuration("knee", 1);
    let text = std::fs::read_to_string(&config).expect("it was written just now");
    // Not even root can create directories there.
    let text = format!("{text}[lncl]\nsocket = \"/proc/nobody/knee.sock\"\n");
    std::fs::write(&config, text).expect("the test's own directory");
    let mut knee = process_under_test(&config, &[]);
    assert_eq!(knee.wait_for_exit(), Some(1));
    let text = knee.output().join("\n");
    assert!(text.contains("cannot create the directory \"/proc/nobody\""), "{text}");
    assert!(text.contains("set another `lncl.socket`") && !text.contains("panicked"), "{text}");
}
