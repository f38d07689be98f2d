//! Received messages and outcomes after the end of a peer, of its former incarnation, or of the node.

use sinew_protocol::payload::{self, Gone};
use sinew_runtime::{
    tid::{AppAddress, Tid},
    wire::{Flags, Message},
};

use super::*;

#[test]
fn messages_before_peer_end_are_received_first() {
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    for number in 1..=3 {
        one.send(other.tid(), &Counted(number)).unwrap();
    }
    let gone = one.tid();
    drop(one);
    for number in 1..=3 {
        let received = other.receive(WATCHDOG).unwrap().expect("its last words");
        assert_eq!(received.decode::<Counted>().unwrap(), Counted(number));
    }
    let deadline = Time::now() + WATCHDOG;
    while !other.direct.open.is_empty() {
        assert!(Time::now() < deadline, "waited for the end of the link to be seen");
        assert!(other.receive(Duration::from_millis(1)).unwrap().is_none());
    }
    let outcome = other.message(gone, &Counted(4)).confirmed(WATCHDOG).unwrap();
    assert!(matches!(outcome, Outcome::Rejected(_)), "through the node again: {outcome:?}");
}

#[test]
fn former_incarnations_ring_is_read_before_the_next() {
    // given
    let node = TestNode::start();
    let wanted = || with_links().fixed_address(AppAddress::fixed(7).unwrap());
    let (mut one, mut other) = (register(&node, wanted()), endpoint(&node));
    link(&mut one, &mut other);
    for number in 1..=3 {
        one.send(other.tid(), &Counted(number)).unwrap();
    }
    // when: the other has not polled since
    one.unregister().unwrap();
    let mut next = register(&node, wanted());
    for number in 4..=5 {
        next.send(other.tid(), &Counted(number)).unwrap();
    }
    // The node's answer follows all earlier messages: they have arrived.
    next.resolve("nobody", WATCHDOG).unwrap();
    // then
    for number in 1..=5 {
        let received = other.receive(WATCHDOG).unwrap().expect("a message");
        assert_eq!(received.decode::<Counted>().unwrap(), Counted(number));
    }
    let deadline = Time::now() + WATCHDOG;
    while !has_link(&other, &next) {
        assert!(Time::now() < deadline, "waited for a link with the next incarnation");
        next.send(other.tid(), &Counted(6)).unwrap();
        drop(other.receive(Duration::from_millis(1)).unwrap());
    }
}

#[test]
fn kept_ring_messages_survive_sender_end() {
    // given
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), register(&node, with_links().inbox_capacity(1)));
    link(&mut one, &mut other);
    for number in 1..=5 {
        one.send(other.tid(), &Counted(number)).unwrap();
    }
    let mut received = vec![other.receive(WATCHDOG).unwrap().expect("a message")];
    // when
    drop(one);
    // then
    let deadline = Time::now() + WATCHDOG;
    while !other.direct.open.is_empty() {
        assert!(Time::now() < deadline, "waited for the end of the link to be seen");
        other.direct.next_check = Time::ZERO;
        received.extend(other.receive(Duration::ZERO).unwrap());
    }
    let numbers: Vec<_> = received.iter().map(|received| received.decode::<Counted>().unwrap().0).collect();
    assert_eq!(numbers, [1, 2, 3, 4, 5]);
}

#[test]
fn in_hand_message_is_unknown_while_peer_process_lives() {
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    let to = other.tid();
    let sending = thread::spawn(move || one.message(to, &Counted(1)).confirmed(WATCHDOG).unwrap());
    let in_hand = other.receive(WATCHDOG).unwrap().expect("a message");
    drop(other);
    assert_eq!(sending.join().unwrap(), Outcome::Unknown, "its receiver may still handle it");
    drop(in_hand);
}

/// Sends the node's report to `one` that the process of its only peer has ended.
fn report_end(node: &TestNode, one: &Gone, to: Tid) {
    let lncl = payload::lncl_of(node.address());
    node.router().send(payload::frame(Kind::LNCL_GONE, lncl, to, one)).unwrap();
}

#[test]
fn ended_process_fails_taken_and_rejects_untaken_messages() {
    for is_taken in [true, false] {
        // given
        let node = TestNode::start();
        let (mut one, mut other) = (endpoint(&node), endpoint(&node));
        link(&mut one, &mut other);
        let (from, to) = (one.tid(), other.tid());
        let gone = Gone { peer: to.bits(), number: one.direct.open[0].number.0 };
        let taken = one.direct.open[0].taken();
        let sending = thread::spawn(move || {
            let outcome = one.message(to, &Counted(1)).confirmed(WATCHDOG).unwrap();
            (outcome, one)
        });
        let in_hand = is_taken.then(|| other.receive(WATCHDOG).unwrap().expect("a message"));
        let deadline = Time::now() + WATCHDOG;
        while !other.direct.open[0].has_unsorted() && !is_taken {
            assert!(Time::now() < deadline, "waited for the message to be in the ring; {taken} were taken");
            thread::yield_now();
        }
        // when
        report_end(&node, &gone, from);
        // then
        let (outcome, _one) = sending.join().unwrap();
        let expected = if is_taken { Outcome::Failed } else { Outcome::Rejected(Rejection::Closed) };
        assert_eq!(outcome, expected);
        drop(in_hand);
    }
}

/// A message of a former incarnation may be handled after one of this incarnation. Both have the same source,
/// destination and path.
#[test]
fn outcome_of_former_incarnation_settles_no_new_message() {
    // given: a message of the former incarnation waits to be received
    let node = TestNode::start();
    let wanted = || Registration::new().fixed_address(AppAddress::fixed(7).unwrap());
    let (former, mut other) = (register(&node, wanted()), register(&node, Registration::new()));
    let mut left = Message::typed(former.tid(), other.tid(), &Counted(1));
    (left.header.class, left.header.flags) = (Class::Bulk, Flags::CONFIRM);
    left.header.correlation = former.requests.correlation + 1;
    former.node.writer.write(&left).unwrap();
    former.unregister().unwrap();
    // when
    let (mut next, to) = (register(&node, wanted()), other.tid());
    let asking = thread::spawn(move || next.message(to, &Urgent(2)).confirmed(WATCHDOG).unwrap());
    let deadline = Time::now() + WATCHDOG;
    let mut held = Vec::new();
    while held.len() < 2 {
        assert!(Time::now() < deadline, "waited for both messages");
        held.extend(other.receive(Duration::from_millis(1)).unwrap());
    }
    let (urgent, left): (Vec<_>, Vec<_>) =
        held.into_iter().partition(|received| received.class() == Class::Control);
    urgent.into_iter().for_each(|received| received.settle(Outcome::Failed));
    left.into_iter().for_each(|received| received.settle(Outcome::Delivered));
    // then
    assert_eq!(asking.join().unwrap(), Outcome::Failed);
}

#[test]
fn links_outlive_node_and_numbers_are_not_reused() {
    // given: a link with messages that were not received
    let mut node = TestNode::start();
    let path = node.path();
    let fixed = |index| with_links().fixed_address(AppAddress::fixed(index).unwrap());
    let (mut one, mut other) = (register(&node, fixed(1)), register(&node, fixed(2)));
    link(&mut one, &mut other);
    let former = one.direct.open[0].number;
    for number in 1..=3 {
        one.send(other.tid(), &Counted(number)).unwrap();
    }
    // when
    node.stop();
    let next = TestNode::start_with(|config| config.lncl.socket = Some(path));
    let mut numbers = Vec::new();
    let deadline = Time::now() + WATCHDOG;
    while one.registrations() < 2 || other.registrations() < 2 {
        assert!(Time::now() < deadline, "waited for both to reconnect");
        for endpoint in [&mut one, &mut other] {
            match endpoint.receive(Duration::from_millis(1)) {
                Ok(received) => {
                    numbers.extend(received.map(|received| received.decode::<Counted>().unwrap().0))
                }
                Err(error) => assert!(matches!(error, ApiError::Disconnected(_)), "{error}"),
            }
        }
    }
    // then
    let path = next.path();
    let mut third = NodeApi::connect(path).unwrap().register_transport_address(fixed(3)).unwrap();
    link(&mut third, &mut one);
    one.send(other.tid(), &Counted(4)).unwrap();
    one.send(third.tid(), &Counted(5)).unwrap();
    while numbers.len() < 4 {
        let received = other.receive(WATCHDOG).unwrap().expect("a message");
        numbers.push(received.decode::<Counted>().unwrap().0);
    }
    assert_eq!(numbers, [1, 2, 3, 4]);
    assert_eq!(third.receive(WATCHDOG).unwrap().expect("a message").decode::<Counted>().unwrap(), Counted(5));
    assert!(one.direct.open.iter().any(|link| link.number == former), "the first link stands");
    assert_eq!(one.direct.open.iter().filter(|link| link.number == former).count(), 1);
}
