//! Applications in processes of their own: the same code, killed in every way, and its node none the worse for it.

use std::path::PathBuf;

use rustix::process::{Pid, Signal, kill_process};
use sinew::{Endpoint, NodeApi, Outcome, Registration, Tid};
use sinew_tests::{
    DEADLINE, OwnDirectory, Program,
    orders::{Count, Me, Order, Who},
    own_group, process_under_test,
};

/// A node with its application, and an endpoint that talks to it.
struct Scenario {
    node: Program,
    endpoint: Endpoint,
    drive: Tid,
    // Last: removed when nobody uses it.
    _directory: OwnDirectory,
}

impl Scenario {
    fn start(arguments: &[&str]) -> Self {
        let directory = OwnDirectory::new();
        let config = configuration(&directory, "robot", 1);
        let mut node = process_under_test(&config, arguments);
        node.wait_for(&["up"]);
        let api = NodeApi::connect(directory.join("robot.sock")).expect("the node is up");
        let wanted = Registration::new().name("test").requires(["drive"]).deadline(DEADLINE);
        let mut endpoint = api.register_transport_address(wanted).expect("the drive becomes ready");
        let drive = endpoint.resolve("drive", DEADLINE).expect("the node answers").expect("it is ready");
        Self { node, endpoint, drive, _directory: directory }
    }

    fn who(&mut self) -> Me {
        self.endpoint.ask(self.drive, &Who {}, DEADLINE).expect("the drive answers")
    }

    fn order(&mut self, order: Order) {
        self.endpoint.send(self.drive, &order).expect("the node takes it");
    }

    /// What was sent before it in its class has been handled then.
    fn count_confirmed(&mut self, number: u64) -> Outcome {
        let told = self.endpoint.send_confirmed(self.drive, &Count { number }, DEADLINE);
        told.expect("the node answers")
    }

    fn count(&mut self, number: u64) {
        self.endpoint.send(self.drive, &Count { number }).expect("the node takes it");
    }
}

fn configuration(directory: &OwnDirectory, name: &str, address: u8) -> PathBuf {
    let path = directory.join(&format!("{name}.toml"));
    let socket = directory.join(&format!("{name}.sock"));
    let text = format!(
        "[node]\nname = \"{name}\"\naddress = \"127.0.0.{address}\"\nproject = \"processes\"\n\
         [lncl]\nsocket = \"{}\"\n[ndl]\nmulticast = \"{}\"\nmdns_port = false\n",
        socket.display(),
        own_group()
    );
    std::fs::write(&path, text).expect("the test's own directory");
    path
}

fn signal(pid: u32, signal: Signal) {
    let pid = i32::try_from(pid).ok().and_then(Pid::from_raw).expect("a process id");
    kill_process(pid, signal).expect("it is alive");
}

#[test]
fn an_application_in_a_process_of_its_own_answers_from_there() {
    let mut scenario = Scenario::start(&[]);
    let me = scenario.who();
    assert_ne!(me.pid, scenario.node.id());
    (1..100).for_each(|number| scenario.count(number));
    assert_eq!(scenario.count_confirmed(100), Outcome::Delivered);
    assert_eq!(scenario.who(), Me { pid: me.pid, counts: (1..=100).collect() });
}

#[test]
fn a_killed_process_is_replaced_and_the_messages_behind_are_kept_in_order() {
    let mut scenario = Scenario::start(&[]);
    let first = scenario.who();
    scenario.order(Order::Hold(500));
    scenario.node.wait_for(&["holds"]);
    (1..=200).for_each(|number| scenario.count(number));
    signal(first.pid, Signal::KILL);
    assert_eq!(scenario.count_confirmed(201), Outcome::Delivered);
    let second = scenario.who();
    assert_ne!(second.pid, first.pid);
    assert_eq!(second.counts, (1..=201).collect::<Vec<_>>());
}
