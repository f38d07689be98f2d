//! Loaned memory in the ring: when the peer sees it, and which other calls continue meanwhile.

use std::{thread, time::Duration};

use sinew_lncl::testing::{TestNode, WATCHDOG};
use sinew_runtime::{
    outcome::{Outcome, Rejection},
    tid::Tid,
    time::Time,
    wire::{Class, Kind},
};

use crate::{DirectLinks, Endpoint, NodeApi, Registration, Transport, tests::TORQUE};

const RAW: Kind = Kind::named("test.raw");

fn register(node: &TestNode, registration: Registration) -> Endpoint {
    NodeApi::connect(node.path()).unwrap().register_transport_address(registration).unwrap()
}

fn endpoint(node: &TestNode) -> Endpoint {
    register(node, Registration::new())
}

fn send(from: &mut Endpoint, to: Tid, bytes: &[u8]) {
    let mut message = from.create_message(to, RAW, bytes.len()).unwrap();
    message.copy_from_slice(bytes);
    from.loaned(message).send().unwrap();
}

#[test]
fn loan_uses_ring_if_it_fits_half_of_it() {
    let node = TestNode::start();
    let endpoint_of = |transport| register(&node, Registration::new().transport(transport));
    let (mut ring, mut socket) = (endpoint_of(Transport::Ring), endpoint_of(Transport::Socket));
    let is_in_place = |endpoint: &mut Endpoint, length| {
        endpoint.create_message(Tid::NONE, RAW, length).unwrap().is_in_place()
    };
    assert!(is_in_place(&mut ring, 0) && is_in_place(&mut ring, 100_000));
    assert!(!is_in_place(&mut ring, 200_000), "half of 256 KiB");
    assert!(!is_in_place(&mut socket, 100));
}

#[test]
fn loaned_memory_is_zeroed_and_aligned() {
    let node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let app = node.local(1);
    let mut endpoint = endpoint(&node);
    for round in 0..20 {
        send(&mut endpoint, app.tid, &[0xAB; 1_000]);
        drop(app.next());
        let message = endpoint.create_message(app.tid, RAW, 900 + round).unwrap();
        assert!(message.iter().all(|byte| *byte == 0));
        assert!(!message.is_in_place() || message.as_ptr().addr().is_multiple_of(8));
    }
}

#[test]
fn unsent_loan_leaves_no_trace() {
    let node = TestNode::start();
    let app = node.local(1);
    let mut endpoint = endpoint(&node);
    for length in [0, 1, 64 * 1024] {
        let mut message = endpoint.create_message(app.tid, RAW, length).unwrap();
        message.fill(0xAB);
        assert!(message.is_in_place());
    }
    send(&mut endpoint, app.tid, b"the only one");
    assert_eq!(app.next().payload[..], *b"the only one");
}

#[test]
fn outcome_during_loan_is_sent_after_it() {
    let node = TestNode::start();
    let app = node.local(1);
    let mut endpoint = endpoint(&node);
    let tid = endpoint.tid();
    for is_sent in [true, false] {
        let outcome = node.send_confirmed(app.tid, tid, &TORQUE);
        let received = endpoint.receive(WATCHDOG).unwrap().expect("a message");
        let message = endpoint.create_message(app.tid, RAW, 10).unwrap();
        // By another thread, as it may be.
        thread::spawn(move || drop(received)).join().unwrap();
        if is_sent {
            endpoint.loaned(message).send().unwrap();
        } else {
            drop(message);
        }
        assert_eq!(outcome.recv_timeout(WATCHDOG), Ok(Outcome::Delivered));
    }
}

#[test]
fn loan_of_other_ring_is_copied_and_frees_it() {
    let node = TestNode::start();
    let app = node.local(1);
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    let mut message = one.create_message(app.tid, RAW, 3).unwrap();
    message.copy_from_slice(b"one");
    assert!(message.is_in_place());
    other.loaned(message).send().unwrap();
    let arrived = app.next();
    assert_eq!((arrived.header.source, &arrived.payload[..]), (other.tid(), &b"one"[..]));
    send(&mut one, app.tid, b"two");
    assert_eq!(app.next().header.source, one.tid());
}

#[test]
fn loan_may_outlive_its_endpoint() {
    let node = TestNode::start();
    let mut endpoint = endpoint(&node);
    let mut message = endpoint.create_message(Tid::NONE, RAW, 10).unwrap();
    drop(endpoint);
    message.fill(1);
    assert_eq!(message[..], [1; 10]);
}

#[test]
fn loan_from_full_ring_waits_for_room_at_send() {
    let node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let app = node.local(1);
    let mut endpoint = endpoint(&node);
    let mut sent = 0_u64;
    let deadline = Time::now() + WATCHDOG;
    let full = loop {
        assert!(Time::now() < deadline, "waited for a ring that is full for a moment");
        let mut message = endpoint.create_message(app.tid, RAW, 1_500).unwrap();
        message[..8].copy_from_slice(&sent.to_le_bytes());
        if !message.is_in_place() {
            break message;
        }
        endpoint.loaned(message).send().unwrap();
        sent += 1;
    };
    endpoint.loaned(full).send().unwrap();
    for number in 0..=sent {
        assert_eq!(app.next().payload[..8], number.to_le_bytes());
    }
}

/// Sends and receives until each has a link with the other.
fn linked(node: &TestNode) -> (Endpoint, Endpoint) {
    let direct = || register(node, Registration::new().direct(DirectLinks::Always));
    let (mut one, mut other) = (direct(), direct());
    let deadline = Time::now() + WATCHDOG;
    send(&mut one, other.tid(), b"hello");
    let has_link = |from: &Endpoint, to: &Endpoint| from.direct.open.iter().any(|link| link.peer == to.tid());
    while !(has_link(&one, &other) && has_link(&other, &one)) {
        assert!(Time::now() < deadline, "waited for a link");
        for endpoint in [&mut one, &mut other] {
            drop(endpoint.receive(Duration::from_millis(1)).unwrap());
        }
    }
    (one, other)
}

#[test]
fn endpoint_sending_only_loans_gets_a_link() {
    let node = TestNode::start();
    drop(linked(&node));
}

#[test]
fn loan_for_direct_link_uses_its_ring() {
    let node = TestNode::start();
    let (mut one, mut other) = linked(&node);
    let mut message = one.create_message(other.tid(), RAW, 7).unwrap();
    message.copy_from_slice(b"in ring");
    assert!(message.is_in_place());
    one.loaned(message).send().unwrap();
    assert_eq!(other.receive(WATCHDOG).unwrap().expect("a message").bytes(), b"in ring");
}

#[test]
fn loan_in_ring_of_ended_peer_is_rejected() {
    let node = TestNode::start();
    let (mut one, other) = linked(&node);
    let to = other.tid();
    let mut message = one.create_message(to, RAW, 7).unwrap();
    other.unregister().unwrap();
    let deadline = Time::now() + WATCHDOG;
    loop {
        let outcome = one.loaned(message).confirmed(WATCHDOG).unwrap();
        if outcome == Outcome::Rejected(Rejection::NoSuchApplication) {
            break;
        }
        // Until the peer's end is detected the message goes into the dead ring, like a copy.
        assert!(matches!(outcome, Outcome::Unknown | Outcome::Rejected(Rejection::Closed)), "{outcome:?}");
        assert!(Time::now() < deadline, "waited for the rejection of an absent receiver");
        message = one.create_message(to, RAW, 7).unwrap();
    }
}

#[test]
fn loaned_stream_value_is_newer_than_waiting_one() {
    let node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let (mut one, mut other) = linked(&node);
    let to = other.tid();
    let stream = |one: &mut Endpoint, value: u64| {
        let mut message = one.create_message(to, RAW, 1_500).unwrap();
        message.set_class(Class::Stream);
        message[..8].copy_from_slice(&value.to_le_bytes());
        let is_in_place = message.is_in_place();
        one.loaned(message).send().unwrap();
        is_in_place
    };
    // given: the ring is full, and a value waits for room
    let mut value = 0;
    while stream(&mut one, value) {
        value += 1;
    }
    // when: there is room again, and the next value is written in place
    drop(other.receive(WATCHDOG).unwrap().expect("a value"));
    value += 1;
    assert!(stream(&mut one, value), "it is lent in place");
    // then: every waiting value has been written by now
    one.direct.open.iter_mut().for_each(|link| link.flush());
    let mut last = 0;
    while let Some(received) = other.receive(Duration::from_millis(100)).unwrap() {
        let arrived = received.bytes().first_chunk().map_or(0, |bytes| u64::from_le_bytes(*bytes));
        assert!(arrived >= last, "{arrived} came after {last}");
        last = arrived;
    }
    assert_eq!(last, value);
}
