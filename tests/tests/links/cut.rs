//! Connections between two nodes are cut while messages flow: each message arrives once, and in order.

use std::net::SocketAddr;

use sinew::Class;
use sinew_testkit::{
    Loopback, all_run,
    history::{History, Note, Party},
    network::{Cut, FaultyNetwork, Listener, Side},
    scripted::{Script, send_jobs, sender_app, wait_for_numbers},
    until,
};

const ROUNDS: u64 = 10;
const MESSAGES: u64 = 100;

#[test]
fn cut_connections_lose_and_reorder_no_message() {
    // Given: two nodes with a network between them that fails on command
    let (loopback, listen) = (Loopback::new(), SocketAddr::from(([127, 0, 0, 1], 0)));
    let listeners = [Side::Left, Side::Right].map(|side| Listener { side, listen, datagrams: false });
    let network = FaultyNetwork::start(&listeners, 1).expect("ports on loopback");
    let node = |name: &str, listener: usize| {
        let SocketAddr::V4(address) = network.address(listener) else { panic!("an address of IPv4") };
        loopback.node(name).configure(|config| config.gncl.announce = Some(address))
    };
    let ((gait, key), (drive, log)) = (sender_app("gait"), Script::new().app("drive"));
    let hip = node("hip", 0).app(gait).start().expect("a node");
    let knee = node("knee", 1).app(drive).start().expect("a node");
    for (listener, node) in [&hip, &knee].into_iter().enumerate() {
        network.set_destination(listener, node.handle().gncl_address().expect("its layers are ready"));
    }
    all_run(&[&hip, &knee]);
    let sender = key.sender();
    until("the drive is known", || sender.resolve("drive"));

    // When: all connections are cut in each round
    for round in 0..ROUNDS {
        send_jobs(&sender, "drive", round * MESSAGES + 1..=(round + 1) * MESSAGES);
        let before = network.counts().cut;
        until("a connection is cut", || {
            network.cut(Cut::Reset);
            (network.counts().cut > before).then_some(())
        });
    }

    // Then
    let (from, to) = (Party { station: 1, incarnation: 1 }, Party { station: 2, incarnation: 1 });
    let (class, mut history) = (Class::Bulk, History::default());
    let count = ROUNDS * MESSAGES;
    history.note(from, Note::Sent { to: to.station, class, first: 1, count, asked: false });
    for first in wait_for_numbers(&log, count as usize) {
        history.note(to, Note::Got { from, class, first, count: 1 });
    }
    assert!(history.verdict().is_perfect(), "{}", history.verdict());
}
