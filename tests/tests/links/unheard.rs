//! Nodes that lose NDL datagrams while their connections deliver.

use std::{
    net::{SocketAddr, UdpSocket},
    path::PathBuf,
};

use rustix::process::Signal;
use sinew_testkit::{
    NodeProcess, TestDirectory,
    network::{FaultyNetwork, Listener, Side},
};
use sinew_tests::node_under_test;

/// Two nodes; the first knows the address of the second and sends to it. All their datagrams pass through the
/// network.
struct Scenario {
    directory: TestDirectory,
    network: FaultyNetwork,
    second_at: SocketAddr,
}

impl Scenario {
    fn new() -> Self {
        let listen = SocketAddr::from(([127, 0, 0, 1], 0));
        let listeners = [Listener { side: Side::Right, listen, datagrams: true }];
        let network = FaultyNetwork::start(&listeners, 1).expect("ports on loopback");
        let free = UdpSocket::bind(listen).expect("a port on loopback");
        let second_at = free.local_addr().expect("it is bound");
        network.set_destination(0, second_at);
        Self { directory: TestDirectory::new(), network, second_at }
    }

    /// The period allows for a machine that runs real-time threads of other tests: the connections must
    /// deliver within it.
    fn configuration(&self, name: &str, address: u8, ndl: &str) -> PathBuf {
        let text = format!(
            "[node]\nname = \"{name}\"\naddress = \"127.0.0.{address}\"\nproject = \"unheard\"\n\
             [ndl]\nmulticast = false\nmdns_port = false\nperiod_ms = 500\n{ndl}\n"
        );
        self.directory.write(&format!("{name}.toml"), &text)
    }

    fn start(&self) -> (NodeProcess, NodeProcess) {
        let knee = self.configuration("knee", 2, &format!("port = {}", self.second_at.port()));
        let hip = self.configuration("hip", 1, &format!("seeds = [\"{}\"]", self.network.address(0)));
        let mut knee = node_under_test(None, &knee, &[]);
        knee.wait_for(&["up"]);
        let mut hip = node_under_test(None, &hip, &["--requires", "knee", "--sends-to", "knee"]);
        hip.wait_for(&["started"]);
        knee.wait_for(&["count 1 "]);
        (hip, knee)
    }

    fn lose_datagrams(&self, are_lost: bool) {
        for side in [Side::Left, Side::Right] {
            self.network.change(side, |faults| faults.parted = are_lost);
        }
    }
}

#[test]
fn node_with_lost_datagrams_is_kept_and_reported() {
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
    let all = [hip.output(), knee.output()].concat();
    assert!(all.iter().all(|line| !line.contains("NodeLost")), "{all:?}");
}

#[test]
fn end_or_hang_of_an_unheard_node_is_noticed() {
    for (signal, why) in [(Signal::KILL, "Crashed"), (Signal::STOP, "Hung")] {
        let scenario = Scenario::new();
        let (mut hip, knee) = scenario.start();
        scenario.lose_datagrams(true);
        hip.wait_for(&["AppStalled", "knee", "NDL", "Unheard"]);
        knee.signal(signal);
        hip.wait_for(&["NodeLost", "knee", why]);
    }
}
