//! The connections of a command's processes. The process of the test plays them.

use rustix::process::{Pid, getpgrp};
use sinew_runtime::{mailbox::Mailbox, outcome::Ticket};

use super::*;
use crate::{CommandPort, LocalApp, Presence, register_command};

/// Registers the command `knee`. Its program has to call `ready`.
pub(super) fn command(node: &TestNode) -> (Arc<CommandPort>, Tid) {
    let port = CommandPort::new("knee", Mailbox::new(8), true);
    let app = LocalApp {
        name: Some("knee".to_owned()),
        address: None,
        requires: vec![],
        kinds: vec![],
        sink: port.clone(),
        events: Arc::new([]),
    };
    let tid = register_command(&node.state, app, port.clone()).expect("the name is free");
    (port, tid)
}

/// The process group of the test, which has all its connections.
fn own_group() -> i32 {
    Pid::as_raw(Some(getpgrp()))
}

fn wait_for(port: &CommandPort, presence: Presence) {
    let mut present = port.presence();
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().expect("a runtime");
    let wait = async {
        tokio::time::timeout(WATCHDOG, present.wait_for(|now| *now == presence))
            .await
            .map(|now| now.map(drop))
    };
    runtime.block_on(wait).expect("it is so in time").expect("the port is there");
}

fn refusal(node: &TestNode, register: &Register) -> String {
    let mut client = RawClient::connect(node);
    client.ask_for_address(register);
    client.expect_refusal()
}

// spec: LNCL-22
#[test]
fn process_of_the_group_gets_address_and_waiting_messages() {
    let node = TestNode::start();
    let ((port, tid), from) = (command(&node), node.local(1).tid);
    // Given: a message for a command without a process
    let first = node.send_confirmed(from, tid, &Angle { degrees: 1.0 });
    port.begin(own_group());
    // When: its process registers
    let (mut client, own) = RawClient::register(&node, &named("knee"));
    // Then:
    assert_eq!((own, client.next().expect("it waited").header.kind), (tid, Angle::KIND));
    wait_for(&port, Presence::Registered);
    client.send(&Message::new(
        Header::new(Kind::LNCL_READY, tid, payload::lncl_of(node.address())),
        Bytes::new(),
    ));
    wait_for(&port, Presence::Ready);
    // When: it ends with the message in hand
    drop(client);
    assert_eq!(first.recv_timeout(WATCHDOG), Ok(Outcome::Failed));
    wait_for(&port, Presence::Absent);
    // Then: later ones wait for the next process
    let second = node.send_confirmed(from, tid, &Angle { degrees: 2.0 });
    port.begin(own_group());
    let (mut client, own) = RawClient::register(&node, &named("knee"));
    let waited = client.next().expect("it waited");
    let Header { source, correlation, .. } = waited.header;
    client.send(&Message::outcome(Ticket { source, destination: own, correlation }, Outcome::Delivered));
    assert_eq!((own, second.recv_timeout(WATCHDOG)), (tid, Ok(Outcome::Delivered)));
}

// spec: LNCL-22
#[test]
fn stray_process_is_refused_the_name_of_a_command() {
    let node = TestNode::start();
    let (port, _) = command(&node);
    let words = "the name 'knee' belongs to a command of this node: process";
    assert!(refusal(&node, &named("knee")).starts_with(words), "no process runs");
    // The group of another process: none of the test's.
    port.begin(own_group().wrapping_add(1));
    let why = refusal(&node, &named("knee"));
    assert!(why.starts_with(words) && why.contains("choose another name"), "{why}");
    assert_eq!(node.refused("registration"), 2);
    RawClient::register(&node, &named("hip"));
}

// spec: LNCL-22
#[test]
fn process_that_outlives_its_command_is_disconnected() {
    let node = TestNode::start();
    let (port, tid) = command(&node);
    let first = port.begin(own_group());
    let (mut former, _) = RawClient::register(&node, &named("knee"));
    wait_for(&port, Presence::Registered);
    // When: the process that the node started has ended, and this one has left its group
    port.end(first);
    // Then: it sends nothing more from the address of the next one
    assert!(former.next().is_none());
    port.begin(own_group());
    let (_client, own) = RawClient::register(&node, &named("knee"));
    assert_eq!(own, tid);
}

#[test]
fn messages_of_a_process_are_handled_before_its_end() {
    const COUNT: usize = 8;
    let node = TestNode::start();
    let ((port, _), app) = (command(&node), node.local(1));
    let process = port.begin(own_group());
    let (mut client, own) = RawClient::register(&node, &named("knee"));
    wait_for(&port, Presence::Registered);
    (0..COUNT).for_each(|_| client.send(&Message::typed(own, app.tid, &Angle { degrees: 1.0 })));
    let runtime = tokio::runtime::Builder::new_current_thread().enable_time().build().expect("a runtime");
    let retired = async { tokio::time::timeout(WATCHDOG, port.retire(process)).await };
    runtime.block_on(retired).expect("its connection ends in time");
    for number in 0..COUNT {
        assert!(app.next_within(Duration::ZERO).is_some(), "message {number} would come after its last will");
    }
}

// spec: LNCL-22
#[test]
fn command_states_requirements_and_address_itself() {
    let node = TestNode::start();
    let (port, tid) = command(&node);
    port.begin(own_group());
    let requiring = Register { requires: vec!["hip".to_owned()], ..named("knee") };
    assert!(refusal(&node, &requiring).contains("state them at the command"));
    let placed = Register { address: AppAddress::fixed(7), ..named("knee") };
    assert!(refusal(&node, &placed).contains("its address is that of the command"));
    // Neither refusal keeps the name.
    let (_client, own) = RawClient::register(&node, &named("knee"));
    assert_eq!(own, tid);
    assert!(refusal(&node, &named("knee")).contains("registered already"));
}
