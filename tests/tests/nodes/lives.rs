//! Whole nodes on this host: found, killed, restarted, stopped in order, configured wrongly.

use std::{
    net::SocketAddrV4,
    path::PathBuf,
    process::Command,
    time::{Duration, Instant},
};

use rustix::process::Signal;
use sinew::{NodeApi, Registration, StartError, address::Incarnation, node::NodeEnd};
use sinew_tests::{
    Ground, OwnDirectory, Program, all_run, node_under_test, own_group, process_under_test, program,
};

/// How often a node that is told to sends.
const SENT_EVERY: Duration = Duration::from_millis(20);

/// Lives of the node that a destructor stops: a lost wake is a race, which one life may win.
const ENDS_OF_PROCESSES: u32 = 30;

/// A node of a scenario: its own address on loopback, the scenario's own multicast group.
struct Scenario {
    directory: OwnDirectory,
    group: SocketAddrV4,
}

impl Scenario {
    fn new() -> Self {
        Self { directory: OwnDirectory::new(), group: own_group() }
    }

    fn configuration(&self, name: &str, address: u8) -> PathBuf {
        let path = self.directory.join(&format!("{name}.toml"));
        let text = format!(
            "[node]\nname = \"{name}\"\naddress = \"127.0.0.{address}\"\nproject = \"nodes\"\n\
             [ndl]\nmulticast = \"{}\"\nmdns_port = false\n",
            self.group
        );
        std::fs::write(&path, text).expect("the test's own directory");
        path
    }

    fn start(&self, name: &str, address: u8, more: &[&str]) -> Program {
        node_under_test(None, &self.configuration(name, address), more)
    }
}

#[test]
fn an_application_waits_for_another_nodes_and_its_messages_arrive_in_order() {
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
fn a_killed_node_is_lost_at_once_and_its_next_life_is_a_restart() {
    let scenario = Scenario::new();
    // That it has started proves that the two are connected.
    let mut hip = scenario.start("hip", 1, &["--requires", "knee"]);
    let knee = scenario.start("knee", 2, &[]);
    hip.wait_for(&["started"]);
    knee.signal(Signal::KILL);
    hip.wait_for(&["NodeLost", "knee", "Crashed"]);
    let mut knee = scenario.start("knee", 2, &[]);
    hip.wait_for(&["NodeRestarted", "knee"]);
    knee.wait_for(&["NodeFound", "hip"]);
}

#[test]
fn a_node_that_is_told_to_stop_tells_its_application_and_says_goodbye() {
    for signal in [Signal::TERM, Signal::INT, Signal::HUP] {
        let scenario = Scenario::new();
        let mut hip = scenario.start("hip", 1, &[]);
        let mut knee = scenario.start("knee", 2, &[]);
        hip.wait_for(&["NodeFound", "knee"]);
        knee.wait_for(&["started"]);
        knee.signal(signal);
        knee.wait_for(&["stopping"]);
        assert_eq!(knee.wait_for_end(), Some(0));
        hip.wait_for(&["NodeLost", "knee", "Left"]);
    }
}

#[test]
fn a_node_whose_hangups_are_ignored_at_its_start_goes_on() {
    let scenario = Scenario::new();
    let mut command = Command::new("sh");
    command.args(["-c", r#"trap "" HUP; exec "$0" "$@""#]).arg(program("node_under_test"));
    command.arg(scenario.configuration("knee", 2)).args(["--says-directory", "--requires", "hip"]);
    let mut knee = Program::start("knee", command);
    knee.wait_for(&["up"]);
    knee.signal(Signal::HUP);
    // It finds and starts what comes later.
    let _hip = scenario.start("hip", 1, &[]);
    knee.wait_for(&["started"]);
    knee.signal(Signal::TERM);
    assert_eq!(knee.wait_for_end(), Some(0));
}

/// The destructor that stops the node runs after those of the thread-local variables that tokio and the log use.
#[test]
fn a_node_that_a_destructor_stops_at_the_end_of_the_process_stops_in_order() {
    let scenario = Scenario::new();
    for life in 0..ENDS_OF_PROCESSES {
        let mut knee = scenario.start("knee", 2, &["--held"]);
        let code = knee.wait_for_end();
        assert_eq!(code, Some(3), "life {life}: {:?}", knee.said());
        assert!(knee.said().iter().any(|line| line.contains("stopping")), "life {life}: {:?}", knee.said());
    }
}

#[test]
fn a_frozen_node_is_lost_and_found_again_when_it_thaws() {
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &[]);
    let mut knee = scenario.start("knee", 2, &[]);
    hip.wait_for(&["NodeFound", "knee"]);
    knee.wait_for(&["NodeFound", "hip"]);
    knee.freeze();
    hip.wait_for(&["NodeLost", "knee", "Hung"]);
    knee.signal(Signal::CONT);
    hip.wait_for(&["NodeFound", "knee"]);
}

#[test]
fn a_wrong_configuration_is_refused_with_all_its_faults() {
    let scenario = Scenario::new();
    let path = scenario.directory.join("wrong.toml");
    std::fs::write(&path, "[node]\nname = \"\"\n[ndl]\nperiod_ms = 1\ncolour = \"red\"\n")
        .expect("own directory");
    let mut wrong = node_under_test(None, &path, &[]);
    assert_eq!(wrong.wait_for_end(), Some(1));
    let said = wrong.said().join("\n");
    for fault in ["node.name", "ndl.period_ms", "ndl.colour"] {
        assert!(said.contains(fault), "{fault} is not in:\n{said}");
    }
}

#[test]
fn a_second_node_with_the_same_address_is_not_let_in() {
    // Given: two nodes, of which one sends to the other
    let (scenario, began) = (Scenario::new(), Instant::now());
    let mut hip = scenario.start("hip", 1, &["--requires", "knee", "--sends-to", "knee"]);
    let mut knee = scenario.start("knee", 2, &[]);
    knee.wait_for(&["count 1 ", "from 127.0.0.1"]);
    // When: another one claims the address of the second, and then a newcomer meets all of them
    let mut impostor = scenario.start("impostor", 2, &[]);
    let mut ankle = scenario.start("ankle", 3, &["--requires", "hip", "--sends-to", "hip"]);
    ankle.wait_for(&["started"]);
    hip.wait_for(&["count", "from 127.0.0.3"]);
    // Then: whichever of the two it is that the newcomer takes for the second, the two that were there go on
    let not_sent_yet = began.elapsed().as_millis() / SENT_EVERY.as_millis() + 1;
    knee.wait_for(&[&format!("count {not_sent_yet} "), "from 127.0.0.1"]);
    assert!(hip.said().iter().all(|line| !line.contains("impostor")));
    // Whether it was up by then, or did not start.
    assert_eq!(impostor.wait_for_end(), Some(1));
}

#[test]
fn a_node_whose_address_another_one_has_ends_with_one_error_and_none_of_its_layers_is_started_again() {
    // Given: a node
    let ground = Ground::new();
    let hip = ground.node("hip").incarnation(Incarnation(1)).start().expect("a node");
    // When: a later life with another name is to have the same address
    let knee = ground.node("knee").address(hip.address()).incarnation(Incarnation(2)).start();
    // Then: whether its layers were ready by then or not, it ends, and says who has it
    let why = match knee {
        Ok(knee) => {
            let handle = knee.handle();
            let NodeEnd::GaveUp(why) = knee.wait_for_end() else { panic!("nobody told it to stop") };
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
fn a_program_whose_nodes_address_another_one_has_says_so_and_not_how_it_looks_inside() {
    // Given
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &[]);
    hip.wait_for(&["up"]);
    // When
    let mut knee = process_under_test(&scenario.configuration("knee", 1), &["--place", "thread"]);
    // Then
    assert_eq!(knee.wait_for_end(), Some(1));
    let said = knee.said();
    let whose = "node address 127.0.0.1 is used already by 'hip' at ";
    assert!(said.iter().any(|line| line.contains(whose)), "{said:#?}");
    assert!(said.iter().all(|line| !line.contains("panicked") && !line.contains("restarts")), "{said:#?}");
}

#[test]
fn a_door_that_another_node_has_is_a_fault_of_the_start_and_free_when_that_one_has_gone() {
    // Given: a node behind a door.
    let (ground, directory) = (Ground::new(), OwnDirectory::new());
    let path = directory.join("node.sock");
    let node = |name: &str| ground.node(name).configure(|config| config.lncl.socket = Some(path.clone()));
    let knee = node("knee").start().expect("the path is free");

    // When: another one is to have the same path.
    let refused = node("hip").start().expect_err("it is taken");

    // Then: it is told what to do, and the first one goes on.
    assert!(matches!(refused, StartError::Door(_)), "{refused:?}");
    let said = refused.to_string();
    for words in ["another node listens", &path.display().to_string(), "set another `lncl.socket`"] {
        assert!(said.contains(words), "{words:?} is not in: {said}");
    }
    let api = NodeApi::connect(&path).expect("a path");
    drop(api.register_transport_address(Registration::new()).expect("the first node serves"));
    knee.stop();
    node("hip").start().expect("the path is free again");
}

#[test]
fn a_door_where_nothing_can_be_made_ends_the_start_in_one_sentence() {
    let scenario = Scenario::new();
    let config = scenario.configuration("knee", 1);
    let text = std::fs::read_to_string(&config).expect("it was written just now");
    // Not even root makes directories there.
    let text = format!("{text}[lncl]\nsocket = \"/proc/nobody/knee.sock\"\n");
    std::fs::write(&config, text).expect("the test's own directory");
    let mut knee = process_under_test(&config, &[]);
    assert_eq!(knee.wait_for_end(), Some(1));
    let said = knee.said().join("\n");
    assert!(said.contains("cannot create the directory \"/proc/nobody\""), "{said}");
    assert!(said.contains("set another `lncl.socket`") && !said.contains("panicked"), "{said}");
}
