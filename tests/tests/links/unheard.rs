//! Nodes between which NDL's datagrams are lost, and whose connections deliver.

use std::{
    net::{SocketAddr, UdpSocket},
    path::PathBuf,
};

use rustix::process::Signal;
use sinew_tests::{
    OwnDirectory, Program, node_under_test,
    proxy::{Door, Proxy, Side},
};

/// Two nodes, of which the first knows where the second is, and sends to it; all their datagrams pass the proxy.
struct Scenario {
    directory: OwnDirectory,
    proxy: Proxy,
    second_at: SocketAddr,
}

impl Scenario {
    fn new() -> Self {
        let listen = SocketAddr::from(([127, 0, 0, 1], 0));
        let doors = [Door { side: Side::Right, listen, datagrams: true }];
        let proxy = Proxy::start(&doors, 1).expect("ports on loopback");
        let free = UdpSocket::bind(listen).expect("a port on loopback");
        let second_at = free.local_addr().expect("it is bound");
        proxy.lead(0, second_at);
        Self { directory: OwnDirectory::new(), proxy, second_at }
    }

    /// With a period that bears what a machine does that runs real-time threads of other tests: their connections have to deliver within it.
    fn configuration(&self, name: &str, address: u8, ndl: &str) -> PathBuf {
        let path = self.directory.join(&format!("{name}.toml"));
        let text = format!(
            "[node]\nname = \"{name}\"\naddress = \"127.0.0.{address}\"\nproject = \"unheard\"\n\
             [ndl]\nmulticast = false\nmdns_port = false\nperiod_ms = 500\n{ndl}\n"
        );
        std::fs::write(&path, text).expect("the test's own directory");
        path
    }

    fn start(&self) -> (Program, Program) {
        let knee = self.configuration("knee", 2, &format!("port = {}", self.second_at.port()));
        let hip = self.configuration("hip", 1, &format!("seeds = [\"{}\"]", self.proxy.address(0)));
        let mut knee = node_under_test(None, &knee, &[]);
        knee.wait_for(&["up"]);
        let mut hip = node_under_test(None, &hip, &["--requires", "knee", "--sends-to", "knee"]);
        hip.wait_for(&["started"]);
        knee.wait_for(&["count 1 "]);
        (hip, knee)
    }

    fn lose_datagrams(&self, are_lost: bool) {
        for side in [Side::Left, Side::Right] {
            self.proxy.change(side, |faults| faults.parted = are_lost);
        }
    }
}

#[test]
fn nodes_whose_connections_deliver_are_not_lost_and_it_is_said_that_their_ndl_is_not_heard() {
    let scenario = Scenario::new();
    let (mut hip, mut knee) = scenario.start();
    for _ in 0..2 {
        scenario.lose_datagrams(true);
        hip.wait_for(&["AppStalled", "knee", "NDL", "Unheard"]);
        knee.wait_for(&["AppStalled", "hip", "NDL", "Unheard"]);
        scenario.lose_datagrams(false);
        hip.wait_for(&["AppResumed", "knee", "NDL"]);
        knee.wait_for(&["AppResumed", "hip", "NDL"]);
    }
    let all = [hip.said(), knee.said()].concat();
    assert!(all.iter().all(|line| !line.contains("NodeLost")), "{all:?}");
}

#[test]
fn of_a_node_that_is_not_heard_it_is_known_when_it_ends_or_hangs() {
    for (signal, why) in [(Signal::KILL, "Crashed"), (Signal::STOP, "Hung")] {
        let scenario = Scenario::new();
        let (mut hip, knee) = scenario.start();
        scenario.lose_datagrams(true);
        hip.wait_for(&["AppStalled", "knee", "NDL", "Unheard"]);
        knee.signal(signal);
        hip.wait_for(&["NodeLost", "knee", why]);
    }
}
