//! A real socket with handwritten clients, as clients in other languages use it.

mod access;
mod commands;
mod documented;
mod forks;
mod pending_outcomes;
mod slow_close;
mod types;
mod unread;
mod waiting;

use std::{sync::Arc, time::Duration};

use bytes::Bytes;
use futures_util::{FutureExt, StreamExt};
use proptest::{prelude::*, strategy::ValueTree, test_runner::TestRunner};
use serde::{Deserialize, Serialize};
use sinew_model::{
    events::NdlEvent,
    facts::{AppFact, NodeEvent},
};
use sinew_protocol::payload::{self, Group, Register, Resolve, Resolved, Undelivered};
use sinew_runtime::{
    outcome::{Outcome, Rejection},
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Class, Flags, HEADER_LEN, Header, Kind, Message, Payload},
};

use super::{
    registrar,
    testing::{RawClient, TestNode, WATCHDOG},
};

#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Angle {
    degrees: f32,
}

impl Payload for Angle {
    const NAME: &'static str = "test.angle";
}

fn named(name: &str) -> Register {
    Register { name: Some(name.to_owned()), ..Register::default() }
}

fn confirmed(source: Tid, destination: Tid, correlation: u64) -> Message {
    let mut message = Message::typed(source, destination, &Angle { degrees: 1.0 });
    message.header.flags = Flags::CONFIRM;
    message.header.correlation = correlation;
    message
}

fn outcome_of(message: &Message) -> (u64, Outcome) {
    assert_eq!((message.header.kind, message.header.flags), (Kind::OUTCOME, Flags::OUTCOME), "{message:?}");
    (message.header.correlation, Outcome::from_code(message.payload[0]).unwrap())
}

/// Checks that a newcomer is served, after any events of others.
fn assert_alive(node: &TestNode) {
    RawClient::register(node, &Register::default());
}

#[test]
fn garbage_is_refused_and_affects_no_other_client() {
    let node = TestNode::start();
    let (mut bystander, tid) = RawClient::register(&node, &named("bystander"));
    let mut client = RawClient::connect(&node);
    client.send_bytes(&[b'x'; 200]);
    assert!(client.expect_refusal().contains("not a Sinew frame"));
    assert_eq!(node.refused("bad first frame"), 1);
    let app = node.local(1);
    bystander.send(&confirmed(tid, app.tid, 1));
    assert_eq!(app.next().decode::<Angle>().unwrap(), Angle { degrees: 1.0 });
    assert_alive(&node);
}

#[test]
fn other_version_is_refused_with_a_reason() {
    let node = TestNode::start();
    let mut client = RawClient::connect(&node);
    let mut bytes = Header::new(Kind::LNCL_REGISTER, Tid::NONE, Tid::NONE).encode(&[]);
    bytes[2] = 9;
    client.send_bytes(&bytes);
    assert!(client.expect_refusal().contains("version 9"));
    assert_alive(&node);
}

#[test]
fn oversized_frame_is_refused_before_and_after_registration() {
    let node = TestNode::start();
    let mut bytes = Header::new(Kind::named("x"), Tid::NONE, Tid::NONE).encode(&[]);
    bytes[4..8].copy_from_slice(&u32::MAX.to_le_bytes());
    let mut unregistered = RawClient::connect(&node);
    unregistered.send_bytes(&bytes);
    assert!(unregistered.expect_refusal().contains("above this node's limit"));
    let (mut client, _) = RawClient::register(&node, &Register::default());
    client.send_bytes(&bytes);
    assert!(client.expect_refusal().contains("above this node's limit"));
    assert_alive(&node);
}

#[test]
fn storm_of_garbage_leaves_the_node_alive() {
    let node = TestNode::start();
    let mut runner = TestRunner::deterministic();
    for _ in 0..50 {
        let noise = proptest::collection::vec(any::<u8>(), 0..600).new_tree(&mut runner).unwrap().current();
        let (mut registered, _) = RawClient::register(&node, &Register::default());
        registered.send_bytes(&noise);
        RawClient::connect(&node).send_bytes(&noise);
    }
    assert_alive(&node);
}

#[test]
fn silent_connection_is_disconnected() {
    let node = TestNode::start();
    let refusal = RawClient::connect(&node).expect_refusal();
    assert!(refusal.contains("LNCL_REGISTER"), "{refusal}");
}

#[test]
fn excess_connection_is_refused_with_a_reason() {
    let node = TestNode::start_with(|config| config.lncl.clients_max = 1);
    let (_first, _) = RawClient::register(&node, &Register::default());
    let mut second = RawClient::connect(&node);
    second.ask_for_address(&Register::default());
    let refusal = second.expect_refusal();
    assert!(refusal.contains("`lncl.clients_max`"), "{refusal}");
}

#[test]
fn connections_of_a_process_are_bounded_with_a_reason() {
    let node = TestNode::start_with(|config| config.lncl.clients_per_process_max = 1);
    let (first, _) = RawClient::register(&node, &Register::default());
    let mut second = RawClient::connect(&node);
    second.ask_for_address(&Register::default());
    let refusal = second.expect_refusal();
    assert!(refusal.contains("`lncl.clients_per_process_max`"), "{refusal}");
    drop(first);
    let mut third = RawClient::connect(&node);
    third.ask_for_address(&Register::default());
    while third.next().is_some_and(|message| message.header.kind == Kind::LNCL_REFUSAL) {
        // The node has not detected the end of the first one yet.
        third = RawClient::connect(&node);
        third.ask_for_address(&Register::default());
    }
}

#[test]
fn silent_connections_of_a_process_are_bounded() {
    let node = TestNode::start_with(|config| config.lncl.strangers_per_process_max = 1);
    let clients: Vec<_> = (0..4).map(|_| RawClient::register(&node, &Register::default())).collect();
    let _silent = RawClient::connect(&node);
    let refusal = RawClient::connect(&node).expect_refusal();
    assert!(refusal.contains("`lncl.strangers_per_process_max`"), "{refusal}");
    assert_eq!(clients.len(), 4);
}

#[test]
fn sender_to_no_destination_is_notified() {
    // As a client does that ignores an unresolved name.
    let node = TestNode::start();
    let (mut client, tid) = RawClient::register(&node, &Register::default());
    client.send(&Message::typed(tid, Tid::NONE, &Angle { degrees: 1.0 }));
    let report = client.next().expect("a report of undelivered messages");
    let Undelivered { entries } = payload::read(&report.payload).unwrap();
    let [entry] = &entries[..] else { panic!("{entries:?} of one destination") };
    assert_eq!((entry.to, entry.count), (Tid::NONE.bits(), 1));
    assert_eq!(Outcome::from_code(entry.why), Some(Outcome::Rejected(Rejection::NoSuchApplication)));
}

#[test]
fn overflow_is_reported_by_count_not_per_message() {
    // The mailbox capacity of the application that the test plays.
    const ROOM: u64 = 1_024;
    const MORE: u64 = 500;
    let node = TestNode::start();
    let app = node.local(1);
    let (mut client, tid) = RawClient::register(&node, &Register::default());
    let started = Time::now();
    for sequence in 1..=ROOM + MORE {
        let mut message = Message::typed(tid, app.tid, &Angle { degrees: 1.0 });
        message.header.sequence = sequence;
        client.send(&message);
    }
    let (mut reported, mut frames) = (0, 0);
    while reported < MORE {
        let report = client.next().expect("a report of undelivered messages");
        assert_eq!((report.header.kind, report.header.class), (Kind::LNCL_UNDELIVERED, Class::Control));
        let Undelivered { entries } = payload::read(&report.payload).unwrap();
        let [entry] = &entries[..] else { panic!("{entries:?} of one destination") };
        assert_eq!(entry.to, app.tid.bits());
        assert_eq!(Outcome::from_code(entry.why), Some(Outcome::Rejected(Rejection::QueueFull)));
        assert!(started <= Time::from_nanos(entry.since) && Time::from_nanos(entry.since) <= Time::now());
        reported += entry.count;
        frames += 1;
    }
    assert_eq!(reported, MORE);
    let tenths = Time::now().since(started).as_millis() / 100;
    assert!(frames <= 2 + tenths, "{frames} frames in {tenths} tenths of a second");
}

#[test]
fn sender_to_a_full_group_member_is_notified() {
    // The mailbox capacity of the application that the test plays.
    const ROOM: u64 = 1_024;
    let node = TestNode::start();
    let (member, group) = (node.local(1), Tid::group("legs"));
    node.state.ctx.router.set_member(group.app, member.tid.app, true);
    let (mut client, tid) = RawClient::register(&node, &Register::default());
    for sequence in 1..=ROOM + 1 {
        let mut message = Message::typed(tid, group, &Angle { degrees: 1.0 });
        message.header.sequence = sequence;
        client.send(&message);
    }
    let report = client.next().expect("a report of undelivered messages");
    let Undelivered { entries } = payload::read(&report.payload).unwrap();
    let [entry] = &entries[..] else { panic!("{entries:?} of one destination") };
    assert_eq!((entry.to, entry.count), (group.bits(), 1));
    assert_eq!(Outcome::from_code(entry.why), Some(Outcome::Rejected(Rejection::QueueFull)));
}

#[test]
fn sender_to_an_empty_group_is_not_notified() {
    let node = TestNode::start();
    let (mut client, tid) = RawClient::register(&node, &Register::default());
    for (sequence, to) in [(1, Tid::group("legs")), (2, Tid::NONE)] {
        let mut message = Message::typed(tid, to, &Angle { degrees: 1.0 });
        message.header.sequence = sequence;
        client.send(&message);
    }
    let report = client.next().expect("a report of undelivered messages");
    let Undelivered { entries } = payload::read(&report.payload).unwrap();
    let destinations: Vec<u64> = entries.iter().map(|entry| entry.to).collect();
    assert_eq!(destinations, [Tid::NONE.bits()]);
}

#[test]
fn reports_fit_a_short_payload_limit_per_destination() {
    let node = TestNode::start_with(|config| config.payload_max = 64);
    let (mut client, tid) = RawClient::register(&node, &Register::default());
    let mut absent: Vec<_> =
        (1..=5).map(|index| Tid::new(node.address(), AppAddress::fixed(index).unwrap())).collect();
    for destination in &absent {
        client.send(&Message::typed(tid, *destination, &Angle { degrees: 1.0 }));
    }
    while !absent.is_empty() {
        let report = client.next().expect("a report of undelivered messages");
        let Undelivered { entries } = payload::read(&report.payload).unwrap();
        let [entry] = &entries[..] else { panic!("{entries:?} have no room in 64 bytes") };
        let at = absent.iter().position(|destination| destination.bits() == entry.to).expect("reported once");
        absent.remove(at);
    }
}

#[test]
fn queues_of_one_process_have_a_common_bound() {
    // Given: two clients of this process that read nothing, with ample room for each and little for both.
    let node = TestNode::start_with(|config| {
        (config.mailbox_capacity, config.mailbox_bytes) = (65_536, 1 << 30);
        config.lncl.clients_bytes = 8 << 20;
    });
    let app = node.local(1);
    let (first, first_tid) = RawClient::register(&node, &Register::default());
    let (_second, second_tid) = RawClient::register(&node, &Register::default());
    let send = |to| {
        let mut header = Header::new(Kind::named("x"), app.tid, to);
        header.class = Class::Bulk;
        node.state.ctx.router.send(Message::new(header, vec![0; 64 << 10].into()))
    };
    let fill = |to| (0..10_000).take_while(|_| send(to).is_ok()).count();

    // When: the queue of one of them fills all that its process may have.
    let taken = fill(first_tid);

    // Then: no more than that is queued, and the other gets as much as its socket holds and no byte more.
    assert!((32..64).contains(&taken), "2 MiB, and what a socket takes: {taken} of 64 KiB");
    assert!(fill(second_tid) < 16, "a socket's worth");
    assert_eq!(send(second_tid), Err(Rejection::QueueFull));

    // And: after the first one has ended, there is room again.
    drop(first);
    let deadline = Time::now() + WATCHDOG;
    while send(second_tid).is_err() {
        assert!(Time::now() < deadline, "waited for room");
        std::thread::yield_now();
    }
}

#[test]
fn forged_source_is_refused_and_its_connection_stays() {
    let node = TestNode::start();
    let app = node.local(1);
    let (mut client, tid) = RawClient::register(&node, &Register::default());
    client.send(&confirmed(app.tid, app.tid, 1));
    let answer = client.next().unwrap();
    assert_eq!(outcome_of(&answer), (1, Outcome::Rejected(Rejection::ForgedSource)));
    assert_eq!(node.refused("forged source"), 1);
    client.send(&confirmed(tid, app.tid, 2));
    let mut message = app.next();
    assert_eq!((message.header.source, message.header.correlation), (tid, 2), "only the honest one arrived");
    message.settle(Outcome::Delivered);
    assert_eq!(outcome_of(&client.next().unwrap()), (2, Outcome::Delivered));
}

#[test]
fn layer_frame_from_an_application_ends_its_connection() {
    let mut node = TestNode::start();
    let (mut client, tid) = RawClient::register(&node, &Register::default());
    client.send(&Message::new(Header::new(Kind::SYNC_DIRECTORY, tid, tid), Bytes::new()));
    assert!(client.expect_refusal().contains("may not send"));
    assert!(matches!(node.fact(), AppFact::Registered { app, .. } if app == tid.app));
    assert_eq!(node.fact(), AppFact::Ready { app: tid.app });
    assert_eq!(node.fact(), AppFact::Unregistered { app: tid.app });
}

#[test]
fn hang_up_frees_the_name_and_fails_messages() {
    let mut node = TestNode::start();
    let app = node.local(1);
    let (mut client, tid) = RawClient::register(&node, &named("drive"));
    let outcome = node.send_confirmed(app.tid, tid, &Angle { degrees: 2.0 });
    assert_eq!(client.next().unwrap().decode::<Angle>().unwrap(), Angle { degrees: 2.0 });
    drop(client);
    assert_eq!(outcome.recv_timeout(WATCHDOG), Ok(Outcome::Failed));
    assert!(matches!(node.fact(), AppFact::Registered { .. }));
    assert!(matches!(node.fact(), AppFact::Ready { .. }));
    assert_eq!(node.fact(), AppFact::Unregistered { app: tid.app });
    let later = node.send_confirmed(app.tid, tid, &Angle { degrees: 3.0 });
    assert_eq!(later.recv_timeout(WATCHDOG), Ok(Outcome::Rejected(Rejection::NoSuchApplication)));
    RawClient::register(&node, &named("drive"));
}

#[test]
fn client_outcome_reaches_the_sender() {
    let node = TestNode::start();
    let app = node.local(1);
    let (mut client, tid) = RawClient::register(&node, &Register::default());
    let outcome = node.send_confirmed(app.tid, tid, &Angle { degrees: 2.0 });
    let message = client.next().unwrap();
    assert!(message.header.flags.has(Flags::CONFIRM));
    let mut answer = Header::new(Kind::OUTCOME, tid, message.header.source);
    answer.flags = Flags::OUTCOME;
    answer.correlation = message.header.correlation;
    let code = Outcome::Rejected(Rejection::ByHandler).code();
    client.send(&Message::new(answer, Bytes::copy_from_slice(&[code])));
    assert_eq!(outcome.recv_timeout(WATCHDOG), Ok(Outcome::Rejected(Rejection::ByHandler)));
}

#[test]
fn node_event_subscribers_are_reported_to_ndl() {
    let mut node = TestNode::start();
    let mut events = node.state.ctx.event_queues.ndl.attach();
    let (_other, _) = RawClient::register(&node, &Register::default());
    let (subscriber, tid) =
        RawClient::register(&node, &Register { events: vec![NodeEvent::KIND], ..Register::default() });
    drop(subscriber);
    let mut next = || match events.next().now_or_never() {
        Some(Some(NdlEvent::App(fact))) => fact,
        other => panic!("NDL received {other:?}"),
    };
    assert_eq!(next(), AppFact::Ready { app: tid.app });
    while node.fact() != (AppFact::Unregistered { app: tid.app }) {}
    assert_eq!(next(), AppFact::Unregistered { app: tid.app });
}

#[test]
fn groups_are_joined_and_left_with_a_confirmation() {
    let mut node = TestNode::start();
    let (mut client, tid) = RawClient::register(&node, &Register::default());
    let group = AppAddress::group("drives");
    node.fact();
    node.fact();
    for member in [true, false] {
        let lncl = payload::lncl_of(node.address());
        let mut asked = payload::frame(Kind::LNCL_GROUP, tid, lncl, &Group { group, member });
        asked.header.flags = Flags::CONFIRM;
        asked.header.correlation = 5;
        client.send(&asked);
        assert_eq!(outcome_of(&client.next().unwrap()), (5, Outcome::Delivered));
        assert_eq!(node.fact(), AppFact::GroupsChanged);
        assert_eq!(node.state.ctx.router.groups().contains(&group), member);
    }
}

#[test]
fn names_resolve_to_tids() {
    let node = TestNode::start();
    let (mut client, tid) = RawClient::register(&node, &named("hip"));
    for (name, expected) in [("hip", Some(tid.bits())), ("nobody", None)] {
        let asked = Resolve { name: name.to_owned(), nearest: false };
        let mut asked = payload::frame(Kind::LNCL_RESOLVE, tid, Tid::NONE, &asked);
        asked.header.correlation = 3;
        client.send(&asked);
        let answer = client.next().unwrap();
        assert_eq!((answer.header.kind, answer.header.correlation), (Kind::LNCL_RESOLVED, 3));
        assert_eq!(payload::read::<Resolved>(&answer.payload).unwrap().tid, expected);
    }
}

#[test]
fn messages_for_a_slow_client_arrive_in_order() {
    let node = TestNode::start();
    let app = node.local(1);
    let (mut client, tid) = RawClient::register(&node, &Register::default());
    // Far more than a socket holds, and less than the queue does.
    let count = 200_u32;
    for number in 0..count {
        let mut header = Header::new(Kind::named("blob"), app.tid, tid);
        header.class = Class::Bulk;
        let mut payload = vec![0; 8_192];
        payload[..4].copy_from_slice(&number.to_le_bytes());
        node.state.ctx.router.send(Message::new(header, payload.into())).unwrap();
    }
    for number in 0..count {
        assert_eq!(client.next().unwrap().payload[..4], number.to_le_bytes());
    }
}

#[test]
fn end_of_lncl_is_reported_and_frees_its_clients() {
    let mut node = TestNode::start();
    let (mut client, tid) = RawClient::register(&node, &named("drive"));
    node.stop();
    assert!(client.expect_refusal().contains("has ended"));
    assert!(registrar::resolve(&node.state, "drive").is_none());
    let later = node.send_confirmed(Tid::NONE, tid, &Angle { degrees: 0.0 });
    assert_eq!(later.recv_timeout(WATCHDOG), Ok(Outcome::Rejected(Rejection::NoSuchApplication)));
    assert!(!node.path().exists());
}

fn filler(source: Tid, destination: Tid) -> Message {
    let mut header = Header::new(Kind::named("blob"), source, destination);
    header.class = Class::Bulk;
    Message::new(header, vec![0; 8_192 - HEADER_LEN].into())
}

#[test]
fn endlessly_nested_registration_is_refused() {
    let node = TestNode::start();
    let mut payload = vec![0x81, 0xa1, b'y'];
    payload.extend([0x91; 8_000]);
    let mut client = RawClient::connect(&node);
    client.send(&Message::new(Header::new(Kind::LNCL_REGISTER, Tid::NONE, Tid::NONE), payload.into()));
    assert!(client.expect_refusal().contains("cannot be read"));
    assert_alive(&node);
}
