//! What is received when a peer, its former life or the node has gone, and what outcomes say then.

use sinew_runtime::{
    tid::{AppAddress, Tid},
    wire::{Flags, Message},
};

use super::*;
use crate::lncl::payload::{self, Gone};

#[test]
fn what_a_peer_said_before_it_went_is_received_and_then_it_has_gone() {
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
    let told = other.message(gone, &Counted(4)).confirmed(WATCHDOG).unwrap();
    assert!(matches!(told, Outcome::Rejected(_)), "through the node again: {told:?}");
}

#[test]
fn what_one_life_of_an_address_wrote_into_its_ring_comes_before_what_the_next_one_sends_through_the_node() {
    // given
    let node = TestNode::start();
    let wanted = || Registration::new().direct(true).fixed_address(AppAddress::fixed(7).unwrap());
    let (mut one, mut other) = (register(&node, wanted()), endpoint(&node));
    link(&mut one, &mut other);
    for number in 1..=3 {
        one.send(other.tid(), &Counted(number)).unwrap();
    }
    // when: the other has not looked since
    one.unregister().unwrap();
    let mut next = register(&node, wanted());
    for number in 4..=5 {
        next.send(other.tid(), &Counted(number)).unwrap();
    }
    // The node answers behind what was sent before: it is there.
    next.resolve("nobody", WATCHDOG).unwrap();
    // then
    for number in 1..=5 {
        let received = other.receive(WATCHDOG).unwrap().expect("a message");
        assert_eq!(received.decode::<Counted>().unwrap(), Counted(number));
    }
    let deadline = Time::now() + WATCHDOG;
    while !has_link(&other, &next) {
        assert!(Time::now() < deadline, "waited for a link with the next life");
        next.send(other.tid(), &Counted(6)).unwrap();
        drop(other.receive(Duration::from_millis(1)).unwrap());
    }
}

#[test]
fn what_was_taken_out_of_a_ring_and_found_no_room_is_received_after_its_senders_end() {
    // given
    let node = TestNode::start();
    let (mut one, mut other) =
        (endpoint(&node), register(&node, Registration::new().direct(true).inbox_capacity(1)));
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
        other.direct.look_at = Time::ZERO;
        received.extend(other.receive(Duration::ZERO).unwrap());
    }
    let numbers: Vec<_> = received.iter().map(|received| received.decode::<Counted>().unwrap().0).collect();
    assert_eq!(numbers, [1, 2, 3, 4, 5]);
}

#[test]
fn a_message_in_the_hand_of_a_peer_that_goes_is_unknown_while_its_process_lives() {
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    let to = other.tid();
    let sending = thread::spawn(move || one.message(to, &Counted(1)).confirmed(WATCHDOG).unwrap());
    let in_hand = other.receive(WATCHDOG).unwrap().expect("a message");
    drop(other);
    assert_eq!(sending.join().unwrap(), Outcome::Unknown, "who has it may handle it yet");
    drop(in_hand);
}

/// What the node says to `one` when the process of its only peer has ended.
fn say_gone(node: &TestNode, one: &Gone, to: Tid) {
    let lncl = payload::lncl_of(node.address());
    node.stores.router.send(payload::frame(Kind::LNCL_GONE, lncl, to, one)).unwrap();
}

#[test]
fn of_a_peer_whose_process_has_ended_what_it_had_taken_has_failed_and_what_it_had_not_was_not_handled() {
    for is_taken in [true, false] {
        // given
        let node = TestNode::start();
        let (mut one, mut other) = (endpoint(&node), endpoint(&node));
        link(&mut one, &mut other);
        let (from, to) = (one.tid(), other.tid());
        let gone = Gone { peer: to.bits(), number: one.direct.open[0].number.0 };
        let taken = one.direct.open[0].taken();
        let sending = thread::spawn(move || {
            let told = one.message(to, &Counted(1)).confirmed(WATCHDOG).unwrap();
            (told, one)
        });
        let in_hand = is_taken.then(|| other.receive(WATCHDOG).unwrap().expect("a message"));
        let deadline = Time::now() + WATCHDOG;
        while !other.direct.open[0].has_something() && !is_taken {
            assert!(Time::now() < deadline, "waited for the message to be in the ring; {taken} were taken");
            thread::yield_now();
        }
        // when
        say_gone(&node, &gone, from);
        // then
        let (told, _one) = sending.join().unwrap();
        let expected = if is_taken { Outcome::Failed } else { Outcome::Rejected(Rejection::Closed) };
        assert_eq!(told, expected);
        drop(in_hand);
    }
}

/// A message of a former life may be handled after one of this life. Both have the same source, destination and way.
#[test]
fn the_outcome_of_a_former_lifes_message_is_not_taken_for_one_of_this_life() {
    // given: a message of the former life waits to be received
    let node = TestNode::start();
    let wanted = || Registration::new().fixed_address(AppAddress::fixed(7).unwrap());
    let (former, mut other) = (register(&node, wanted()), register(&node, Registration::new()));
    let mut left = Message::typed(former.tid(), other.tid(), &Counted(1));
    (left.header.class, left.header.flags) = (Class::Bulk, Flags::CONFIRM);
    left.header.correlation = former.correlation + 1;
    former.writer.write(&left).unwrap();
    former.unregister().unwrap();
    // when
    let (mut next, to) = (register(&node, wanted()), other.tid());
    let asking = thread::spawn(move || next.message(to, &Hurried(2)).confirmed(WATCHDOG).unwrap());
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
fn links_outlive_the_node_and_none_of_its_next_life_has_the_number_of_one_of_the_former() {
    // given: a link with messages that were not received
    let mut node = TestNode::start();
    let path = node.path();
    let fixed = |index| Registration::new().direct(true).fixed_address(AppAddress::fixed(index).unwrap());
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
        assert!(Time::now() < deadline, "waited for both to be back");
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
    let path = next.stores.config.lncl.socket.clone().expect("it was set");
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
