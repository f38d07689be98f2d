//! Whole nodes with keys on this host: one with a reset clock, and one with a revoked certificate.

use std::{
    net::{Ipv4Addr, SocketAddrV4},
    path::PathBuf,
    time::{Duration, Instant},
};

use rustix::process::Signal;
use sinew::{
    Endpoint, NodeApi, NodeBuilder, Registration,
    node::DenyListError,
    prelude::*,
    security::{Certificate, Identity, files},
};
use sinew_testkit::{DEADLINE, NodeProcess, TestDirectory, keys, own_group, until};
use sinew_tests::node_under_test;

payload!("keys.torque", Control => struct Torque { newton_metres: f64 });

/// Accepts every torque.
struct Drive;

impl Actor for Drive {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<Torque>> for Drive {
    type Result = ();

    fn handle(&mut self, _: Delivery<Torque>, _: &mut Self::Context) {}
}

const PROJECT: &str = "keys";
const NAMES: [&str; 2] = ["hip", "knee"];
/// Half a minute after the start of 1970, in microseconds: a board without a battery for its clock.
const AT_THE_BEGINNING: &str = "30000000";
/// Time for which a lost incarnation bars an earlier one (NDL-5.2).
const BARRED: Duration = Duration::from_secs(15);
/// Time in which a slow and busy machine starts a node and the node is found.
const FOUND: Duration = Duration::from_secs(45);

/// Two nodes with keys of one project, each with an address of its own on loopback.
struct Robot {
    directory: TestDirectory,
    group: SocketAddrV4,
}

impl Robot {
    fn new() -> Self {
        let directory = TestDirectory::new();
        let identity = |index: usize| Identity {
            project: PROJECT.to_owned(),
            address: address(index).into(),
            name: NAMES[index].to_owned(),
        };
        keys::make(&directory.join("keys"), &[identity(0), identity(1)]).expect("the test's own directory");
        Self { directory, group: own_group() }
    }

    fn keys(&self, index: usize) -> PathBuf {
        self.directory.join("keys").join(NAMES[index])
    }

    fn start(&self, index: usize, more: &[&str]) -> NodeProcess {
        let path = self.directory.join(&format!("{}.toml", NAMES[index]));
        let text = format!(
            "[node]\nname = \"{}\"\naddress = \"{}\"\nproject = \"{PROJECT}\"\n[ndl]\nmulticast = \"{}\"\nmdns_port = false\n\
             [security]\nkeys = {:?}\n",
            NAMES[index],
            address(index),
            self.group,
            self.keys(index)
        );
        std::fs::write(&path, text).expect("the test's own directory");
        node_under_test(None, &path, more)
    }
}

impl Robot {
    /// The same node, in this process.
    fn builder(&self, index: usize) -> NodeBuilder {
        Node::builder(NAMES[index]).address(address(index)).configure(|config| {
            config.project = PROJECT.to_owned();
            config.ndl.multicast = Some(self.group);
            config.ndl.mdns_port = None;
            config.security.keys = Some(self.keys(index));
            config.lncl.socket = Some(self.door(index));
        })
    }

    fn door(&self, index: usize) -> PathBuf {
        self.directory.join(&format!("{}.sock", NAMES[index]))
    }

    fn revoke(&self, index: usize, at: usize) {
        let certificate = Certificate::from_file(&self.keys(index).join(files::NODE_CERTIFICATE));
        let serial = certificate.expect("it was just made").serial().to_string();
        keys::put(&self.keys(at), files::DENIED, 0o644, &serial).expect("the test's own directory");
    }
}

fn address(index: usize) -> Ipv4Addr {
    Ipv4Addr::new(127, 0, 0, index as u8 + 1)
}

// spec: NDL-5.2
#[test]
fn node_with_reset_clock_returns_after_15_s() {
    // Given: two nodes that have authenticated each other
    let robot = Robot::new();
    let mut hip = robot.start(0, &["--requires", "knee", "--sends-to", "knee", "--logs"]);
    let mut knee = robot.start(1, &[]);
    knee.wait_for(&["count 1 from 127.0.0.1"]);
    // When: one loses its power, and returns with a clock at 1970
    knee.signal(Signal::KILL);
    hip.wait_for(&["NodeLost", "knee", "Crashed"]);
    let lost = Instant::now();
    let mut knee = robot.start(1, &["--incarnation", AT_THE_BEGINNING]);
    // Then: it is barred, with a reason in the log, and later it is not
    hip.wait_for(&["NDL answer of a former incarnation", "its clock went back"]);
    hip.wait_for(&["NodeRestarted", "knee", AT_THE_BEGINNING]);
    let took = lost.elapsed();
    println!("found {took:?} after its loss");
    assert!(took < BARRED + FOUND, "found {took:?} after its loss");
    knee.wait_for(&["count", "from 127.0.0.1"]);
    hip.wait_for(&["requirement", "Met", "knee"]);
}

fn send(gait: &mut Endpoint, to: Tid, within: Duration) -> Outcome {
    gait.message(to, &Torque { newton_metres: 1.0 }).confirmed(within).expect("it is sent")
}

// spec: GNCL-18
#[test]
fn revoked_node_is_cut_off_by_the_deny_list() {
    // Given: the hip sends to a drive of the knee
    let robot = Robot::new();
    let drive = AppSpec::new("drive", || Drive).handles::<Torque>();
    let (hip, knee) = (robot.builder(0).start(), robot.builder(1).app(drive).start());
    let (_hip, knee) = (hip.expect("a node"), knee.expect("a node"));
    let api = NodeApi::connect(robot.door(0)).expect("its door");
    let registration = Registration::new().name("gait").requires(["drive"]).deadline(DEADLINE);
    let mut gait = api.register_transport_address(registration).expect("it is registered");
    let drive = gait.resolve("drive", DEADLINE).expect("an answer").expect("it is there");
    assert_eq!(send(&mut gait, drive, DEADLINE), Outcome::Delivered);
    // When: an invalid list, which changes nothing
    keys::put(&robot.keys(1), files::DENIED, 0o644, "hip\n").expect("the test's own directory");
    let faults = knee.handle().reload_deny_list().expect_err("that is no number").to_string();
    assert!(faults.contains("line 1") && faults.contains("stays"), "{faults}");
    assert_eq!(send(&mut gait, drive, DEADLINE), Outcome::Delivered);
    // When: the hip is revoked
    robot.revoke(0, 1);
    assert_eq!(knee.handle().reload_deny_list().expect("it is good").denied, 1);
    // Then: the link ends, and there is no other one; on a slow machine a message may arrive late before that
    let soon = Duration::from_millis(500);
    let mut missed = 0;
    until("it reaches nobody any more", || {
        missed = if send(&mut gait, drive, soon) == Outcome::Delivered { 0 } else { missed + 1 };
        (missed == 4).then_some(())
    });
    // When: the knee itself is revoked
    robot.revoke(1, 1);
    let own = knee.handle().reload_deny_list();
    assert!(matches!(own, Err(DenyListError::Own { .. })), "{own:?}");
}

#[test]
fn node_without_keys_has_no_deny_list() {
    let node = sinew_testkit::Loopback::new().node("hip").start().expect("a node");
    assert!(matches!(node.handle().reload_deny_list(), Err(DenyListError::None)));
}
