//! Whole nodes with keys on this host: one whose clock began anew, and one whose certificate is revoked.

use std::{
    net::{Ipv4Addr, SocketAddrV4},
    path::PathBuf,
    time::{Duration, Instant},
};

use rustix::process::Signal;
use sinew::security::Identity;
use sinew_tests::{OwnDirectory, Program, keys, node_under_test, own_group};

const PROJECT: &str = "keys";
const NAMES: [&str; 2] = ["hip", "knee"];
/// Half a minute after the beginning of 1970, in microseconds: a board without a battery for its clock.
const AT_THE_BEGINNING: &str = "30000000";
/// For so long a lost life bars an earlier one (NDL-5.2).
const BARRED: Duration = Duration::from_secs(15);
/// Time in which a machine that is busy otherwise starts a node and has it found.
const FOUND: Duration = Duration::from_secs(10);

/// Two nodes with keys of one project, each with an address of its own on loopback.
struct Robot {
    directory: OwnDirectory,
    group: SocketAddrV4,
}

impl Robot {
    fn new() -> Self {
        let directory = OwnDirectory::new();
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

    fn start(&self, index: usize, more: &[&str]) -> Program {
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

fn address(index: usize) -> Ipv4Addr {
    Ipv4Addr::new(127, 0, 0, index as u8 + 1)
}

// spec: NDL-5.2
#[test]
fn a_node_whose_clock_began_anew_is_there_again_15_s_after_its_loss() {
    // Given: two nodes that have proven themselves to each other
    let robot = Robot::new();
    let mut hip = robot.start(0, &["--requires", "knee", "--sends-to", "knee", "--logs"]);
    let mut knee = robot.start(1, &[]);
    knee.wait_for(&["count 1 from 127.0.0.1"]);
    // When: one loses its power, and is back with a clock that stands at 1970
    knee.signal(Signal::KILL);
    hip.wait_for(&["NodeLost", "knee", "Crashed"]);
    let lost = Instant::now();
    let mut knee = robot.start(1, &["--incarnation", AT_THE_BEGINNING]);
    // Then: it is barred, with a reason in words, and then it is not
    hip.wait_for(&["NDL answer of a former life", "its clock went back"]);
    hip.wait_for(&["NodeRestarted", "knee", AT_THE_BEGINNING]);
    let took = lost.elapsed();
    println!("found {took:?} after its loss");
    assert!(took < BARRED + FOUND, "found {took:?} after its loss");
    knee.wait_for(&["count", "from 127.0.0.1"]);
    hip.wait_for(&["requirement", "Met", "knee"]);
}
