//! Endpoints that reconnect by themselves after a restart of LNCL.

use std::thread;

use sinew::{
    Endpoint, NodeApi, Registration,
    client::{ApiError, Transport},
    fault::Fault,
    prelude::*,
};
use sinew_testkit::{DEADLINE, Loopback, TestDirectory, all_run, ready_for, scripted::Job, until};

/// A node, a connection to it, and the directory of its socket.
fn node_and_its_door() -> (Node, NodeApi, TestDirectory) {
    let directory = TestDirectory::new();
    let socket = directory.join("node.sock");
    let door = socket.clone();
    let node = Loopback::new().node("node").configure(|config| config.lncl.socket = Some(door));
    let node = node.start().expect("a node");
    all_run(&[&node]);
    let api = NodeApi::connect(&socket).expect("somebody listens");
    (node, api, directory)
}

/// Receives, without answering, until the endpoint has registered `times` times.
fn come_back(endpoint: &mut Endpoint, times: u64) {
    until("the endpoint is back", || {
        match endpoint.receive(Duration::from_millis(20)) {
            // It reports the end of its connection once.
            Ok(None) | Err(ApiError::Disconnected(_)) => {}
            other => panic!("{other:?}"),
        }
        (endpoint.registrations() == times).then_some(())
    });
}

fn comes_back(transport: Transport) {
    // Given: two endpoints, one of them in a group, and a message in flight between them
    let (node, api, _directory) = node_and_its_door();
    let register = |name: &str| {
        let registration = Registration::new().name(name).transport(transport);
        api.register_transport_address(registration).expect("the name is free")
    };
    let (mut drive, mut hip) = (register("drive"), register("hip"));
    let (drive_tid, hip_tid) = (drive.tid(), hip.tid());
    drive.join("drives").expect("there is room in it");
    let asking = thread::spawn(move || {
        let outcome = hip.message(drive_tid, &Job { number: 1 }).confirmed(DEADLINE);
        (hip, outcome)
    });
    let in_hand = drive.receive(DEADLINE).expect("the node is there").expect("a message in time");
    // When
    node.handle().inject("LNCL", Fault::panic()).expect("every node has it");
    ready_for(&node.handle(), "LNCL", 2);
    // Then: the fate of the message is unknown
    let (mut hip, outcome) = asking.join().expect("no panic");
    assert!(matches!(outcome, Ok(Outcome::Unknown | Outcome::Failed)), "{outcome:?}");
    in_hand.settle(Outcome::Delivered);
    // And: both are back under the same names and addresses, and in their groups
    come_back(&mut drive, 2);
    come_back(&mut hip, 2);
    assert_eq!((drive.tid(), hip.tid()), (drive_tid, hip_tid));
    assert_eq!(hip.resolve("drive", DEADLINE).expect("an answer"), Some(drive_tid));
    hip.send(Tid::group("drives"), &Job { number: 2 }).expect("there is room");
    let received = drive.receive(DEADLINE).expect("the node is there").expect("a message in time");
    assert_eq!(received.decode::<Job>().expect("a job").number, 2);
}

#[test]
fn ring_endpoints_reconnect_after_lncl_panics() {
    comes_back(Transport::Ring);
}

#[test]
fn socket_endpoints_reconnect_after_lncl_panics() {
    comes_back(Transport::Socket);
}

/// After 2 s a node gives up a client that began to register and does not continue.
#[test]
fn endpoint_used_rarely_still_reconnects() {
    let (node, api, _directory) = node_and_its_door();
    let mut seldom = api.register_transport_address(Registration::new().name("seldom")).expect("an address");
    let to = seldom.tid();
    node.handle().inject("LNCL", Fault::panic()).expect("every node has it");
    ready_for(&node.handle(), "LNCL", 2);
    // Three on a fast machine: each proceeds as far as it is answered at once.
    let calls = (1..=20).find(|_| {
        thread::sleep(Duration::from_millis(2_100));
        seldom.send(to, &Job { number: 1 }).is_ok()
    });
    assert!(calls.is_some(), "it never comes back");
    assert_eq!(seldom.registrations(), 2);
}
