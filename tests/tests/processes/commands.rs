//! Commands: programs that a node starts, with every way to end, to hang, and to take a name that is not theirs.

use std::{process::Command, time::Duration};

use rustix::process::Signal;
use sinew::{Endpoint, NodeApi, Outcome, Registration, Tid, client::ApiError, message::Rejection};
use sinew_testkit::{DEADLINE, NodeProcess, TestDirectory, program, sandbox::after_shell, until};
use sinew_tests::{
    orders::{Count, Me, Order, Who},
    role,
};

use super::scenario::{Watched, configuration, signal};

/// Its programs may be restarted as often as they fail.
const RESTARTS: &str = "[supervision]\napp_restarts_max = 1000\napp_window_ms = 1\n";
const PYTHON: &str = include_str!("commands/register.py");

/// A node with the command `drive`.
struct Robot {
    node: NodeProcess,
    directory: TestDirectory,
}

/// An endpoint beside it.
struct Other {
    endpoint: Endpoint,
    drive: Tid,
}

/// A list of texts, as in a file.
fn list(words: &[&str]) -> String {
    let words: Vec<_> = words.iter().map(|word| format!("{word:?}")).collect();
    format!("[{}]", words.join(", "))
}

impl Robot {
    /// Starts the node with `more` in its command. The program has these arguments.
    fn start(more: &str, arguments: &[&str]) -> Self {
        let scenarios = program("scenarios");
        let scenarios = scenarios.to_str().expect("its path is text");
        Self::start_running(more, &[&[scenarios, "--role", "commanded"], arguments].concat())
    }

    fn start_running(more: &str, run: &[&str]) -> Self {
        let mut robot = Self::begin(TestDirectory::new(), more, run);
        robot.node.wait_for(&["is up"]);
        robot
    }

    fn begin(directory: TestDirectory, more: &str, run: &[&str]) -> Self {
        let (before, more) = more.split_once("---\n").unwrap_or(("", more));
        let command = format!("{before}[[command]]\nname = \"drive\"\nrun = {}\n{more}", list(run));
        let mut node = role("command_node");
        node.arg(configuration(&directory, &command));
        Self { node: NodeProcess::start("robot", after_shell("exec 2>&1", &node)), directory }
    }

    fn api(&self) -> NodeApi {
        NodeApi::connect(self.directory.join("robot.sock")).expect("the node is up")
    }

    /// Waits until the drive is ready.
    fn other(&self) -> Other {
        let wanted = Registration::new().requires(["drive"]).deadline(DEADLINE);
        let mut endpoint = self.api().register_transport_address(wanted).expect("the drive becomes ready");
        let drive = endpoint.resolve("drive", DEADLINE).expect("the node answers").expect("it is ready");
        Other { endpoint, drive }
    }

    /// Tries to take the name of the drive. Returns the reason of the refusal.
    fn refusal(&self) -> String {
        let refused = self.api().register_transport_address(Registration::new().name("drive"));
        let error = refused.expect_err("the name is not for this process");
        let ApiError::Refused(why) = error else { panic!("{error}") };
        why
    }
}

impl Other {
    fn who(&mut self) -> Me {
        self.endpoint.message(self.drive, &Who {}).ask(DEADLINE).expect("the drive answers")
    }

    fn count(&mut self, number: u64) {
        self.endpoint.send(self.drive, &Count { number }).expect("the node takes it");
    }

    fn count_confirmed(&mut self, number: u64) -> Outcome {
        let counted = self.endpoint.message(self.drive, &Count { number }).confirmed(DEADLINE);
        counted.expect("the node answers")
    }

    fn order(&mut self, order: &Order) {
        self.endpoint.send(self.drive, order).expect("the node takes it");
    }

    fn order_confirmed(&mut self, order: &Order) -> Outcome {
        self.endpoint.message(self.drive, order).confirmed(DEADLINE).expect("the node answers")
    }
}

#[test]
fn registered_program_is_ready_and_its_output_is_logged() {
    let mut robot = Robot::start("", &[]);
    let mut other = robot.other();
    let me = other.who();
    assert_ne!(me.pid, robot.node.id());
    let started = format!("program {} of drive started", me.pid);
    robot.node.wait_for(&[started.as_str(), "app", "drive", "stdout"]);
    assert_eq!(other.count_confirmed(1), Outcome::Delivered);
}

#[test]
fn program_is_ready_when_it_calls_ready() {
    let directory = TestDirectory::new();
    let file = directory.join("ready");
    let path = file.to_str().expect("its path is text");
    let robot = Robot::start("ready = \"called\"\n", &["--ready-when", path]);
    let wanted = || Registration::new().requires(["drive"]);
    let early = robot.api().register_transport_address(wanted().deadline(Duration::from_millis(300)));
    assert!(early.is_err(), "it cannot be ready yet");
    std::fs::write(&file, "").expect("the test's own directory");
    robot.api().register_transport_address(wanted().deadline(DEADLINE)).expect("it is ready");
}

#[test]
fn crashed_program_is_replaced_behind_the_same_address() {
    let mut robot = Robot::start("backoff_min_ms = 2000\n", &[]);
    let mut other = robot.other();
    let first = other.who();
    assert_eq!(other.order_confirmed(&Order::Exit(3)), Outcome::Failed);
    robot.node.wait_for(&["a child failed", "its process ended: exit code 3"]);
    (1..=20).for_each(|number| other.count(number));
    // Behind them: it has their class.
    assert_eq!(other.count_confirmed(21), Outcome::Delivered);
    let second = other.who();
    assert_ne!(second.pid, first.pid);
    assert_eq!(second.counts, (1..=21).collect::<Vec<_>>());
    let drive = other.endpoint.resolve("drive", DEADLINE).expect("the node answers");
    assert_eq!(drive, Some(other.drive));
}

#[test]
fn signal_that_ended_a_program_is_named() {
    let mut robot = Robot::start(&format!("{RESTARTS}---\n"), &[]);
    let mut other = robot.other();
    let pid = other.who().pid;
    assert_eq!(other.order_confirmed(&Order::Kill), Outcome::Failed);
    robot.node.wait_for(&["a child failed", "killed by signal 9 (SIGKILL)"]);
    assert_ne!(other.who().pid, pid);
}

#[test]
fn hung_program_is_killed_and_replaced() {
    let mut robot = Robot::start("hang_ms = 200\n", &[]);
    let mut other = robot.other();
    let process = Watched::new(other.who().pid);
    assert_eq!(other.order_confirmed(&Order::Hang), Outcome::Failed);
    process.wait_for_end();
    robot.node.wait_for(&["a child failed", "hung: its program has read nothing"]);
    assert_eq!(other.count_confirmed(1), Outcome::Delivered);
}

#[test]
fn stopped_program_without_messages_is_killed_and_replaced() {
    let mut robot = Robot::start("hang_ms = 200\n", &[]);
    let mut other = robot.other();
    let pid = other.who().pid;
    let process = Watched::new(pid);
    signal(pid, Signal::STOP);
    process.wait_for_end();
    robot.node.wait_for(&["a child failed", "hung: its program has read nothing"]);
    assert_ne!(other.who().pid, pid);
}

#[test]
fn transient_program_that_ends_in_order_is_not_replaced() {
    let robot = Robot::start("restart = \"transient\"\n", &[]);
    let mut other = robot.other();
    let process = Watched::new(other.who().pid);
    other.order(&Order::Stop);
    process.wait_for_end();
    until("the end of the drive for good", || {
        (other.count_confirmed(1) == Outcome::Rejected(Rejection::Closed)).then_some(())
    });
    assert!(robot.refusal().contains("belongs to a command of this node"));
}

#[test]
fn death_at_each_start_ends_the_node_with_reason() {
    // However long each start takes.
    let window = "[supervision]\napp_window_ms = 3600000\n---\n";
    let mut robot = Robot::start(window, &["--dies-at-start", "3"]);
    robot.node.wait_for(&["gave up", "applications: more than 5 restarts", "exit code 3"]);
    assert_eq!(robot.node.wait_for_exit(), Some(1));
}

#[test]
fn unregistered_program_is_killed_and_started_again() {
    let mut robot = Robot::start(&format!("{RESTARTS}---\nstart_ms = 500\n"), &["--never-registers"]);
    for _ in 0..2 {
        let line = robot.node.wait_for(&["program ", " of drive started"]);
        let pid = line.split_once("program ").and_then(|(_, rest)| rest.split(' ').next()?.parse().ok());
        let pid: u32 = pid.unwrap_or_else(|| panic!("no process in {line:?}"));
        assert!(robot.refusal().contains("belongs to a command of this node"));
        robot.node.wait_for(&["did not become ready in its time"]);
        // It has ended by now, or ends.
        until("its end", || std::fs::metadata(format!("/proc/{pid}")).is_err().then_some(()));
    }
}

#[test]
fn stray_process_cannot_take_the_name() {
    let robot = Robot::start("", &[]);
    let mut other = robot.other();
    let why = robot.refusal();
    assert!(why.contains("the name 'drive' belongs to a command of this node"), "{why}");
    assert!(why.contains("choose another name"), "{why}");
    assert_eq!(other.count_confirmed(1), Outcome::Delivered);
}

#[test]
fn stop_ends_the_program_and_its_descendants() {
    let mut robot = Robot::start("", &[]);
    let mut other = robot.other();
    let program = Watched::new(other.who().pid);
    other.order(&Order::StartASleeper(false));
    let line = robot.node.wait_for(&["sleeper "]);
    let pid = line.split_once("sleeper ").and_then(|(_, rest)| rest.split(' ').next()?.parse().ok());
    let sleeper = Watched::new(pid.unwrap_or_else(|| panic!("no process in {line:?}")));
    robot.node.signal(Signal::TERM);
    assert_eq!(robot.node.wait_for_exit(), Some(0));
    program.wait_for_end();
    sleeper.wait_for_end();
}

#[test]
fn program_dies_with_its_node() {
    let robot = Robot::start("", &[]);
    let process = Watched::new(robot.other().who().pid);
    robot.node.signal(Signal::KILL);
    process.wait_for_end();
}

#[test]
fn program_that_is_not_there_is_named() {
    let mut robot = Robot::start_running("", &["/there/is/no/program"]);
    robot.node.wait_for(&["a child failed", "'/there/is/no/program' cannot be executed", "write its path"]);
}

#[test]
fn node_without_a_socket_refuses_a_command() {
    let directory = TestDirectory::new();
    let file = directory
        .write("robot.toml", "[node]\nname = 'robot'\n[[command]]\nname = 'drive'\nrun = ['true']\n");
    let why = sinew::NodeConfig::from_file(file).expect_err("its program could not join").to_string();
    assert!(why.contains("lncl.socket") && why.contains("[[command]]"), "{why}");
}

#[test]
fn python_program_joins_by_the_protocol_alone() {
    let is_there = Command::new("python3").arg("--version").output();
    if !is_there.is_ok_and(|output| output.status.success()) {
        println!("skipped: there is no python3 on this machine");
        return;
    }
    let mut robot = Robot::start_running("", &["python3", "-c", PYTHON]);
    robot.node.wait_for(&["python is registered as drive"]);
    let mut other = robot.other();
    assert_eq!(other.count_confirmed(1), Outcome::Delivered);
    robot.node.signal(Signal::TERM);
    robot.node.wait_for(&["python was told to stop"]);
    assert_eq!(robot.node.wait_for_exit(), Some(0));
}
