//! Direct links against a real LNCL: two endpoints that exchange messages, and what each sees when the other ends.

use std::{
    io::{IoSlice, Read},
    mem::MaybeUninit,
    os::{fd::AsFd, unix::net::UnixStream},
    thread,
    time::Duration,
};

use rustix::net::{SendAncillaryBuffer, SendAncillaryMessage, SendFlags, sendmsg};
use serde::{Deserialize, Serialize};
use sinew_runtime::{
    outcome::{Outcome, Rejection},
    tid::AppAddress,
    time::Time,
    wire::{Class, Flags, Header, Kind, Message, Payload},
};

use super::{Came, budget::Budget};
use crate::{
    api::{ApiError, Endpoint, NodeApi, Registration},
    lncl::{
        payload::{self, Introduction, Switch},
        testing::{TestNode, WATCHDOG},
    },
};

#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Counted(u64);

impl Payload for Counted {
    const NAME: &'static str = "test.counted";
}

#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Hurried(u64);

impl Payload for Hurried {
    const NAME: &'static str = "test.hurried";
    const CLASS: Class = Class::Control;
}

#[derive(Debug, PartialEq, Serialize, Deserialize)]
struct Setpoint(u64);

impl Payload for Setpoint {
    const NAME: &'static str = "test.setpoint";
    const CLASS: Class = Class::Stream;
}

fn register(node: &TestNode, registration: Registration) -> Endpoint {
    NodeApi::connect(node.path()).unwrap().register_transport_address(registration).unwrap()
}

fn endpoint(node: &TestNode) -> Endpoint {
    register(node, Registration::new().direct(true))
}

fn has_link(from: &Endpoint, to: &Endpoint) -> bool {
    from.direct.open.iter().any(|link| link.peer == to.tid())
}

/// Sends and receives until each has an open link with the other.
fn link(one: &mut Endpoint, other: &mut Endpoint) {
    let deadline = Time::now() + WATCHDOG;
    one.send(other.tid(), &Counted(0)).unwrap();
    while !(has_link(one, other) && has_link(other, one)) {
        assert!(Time::now() < deadline, "waited for a link between {one:?} and {other:?}");
        for endpoint in [&mut *one, &mut *other] {
            drop(endpoint.receive(Duration::from_millis(1)).unwrap());
        }
    }
}

#[test]
fn two_that_send_to_each_other_do_it_directly_after_a_while() {
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    one.send(other.tid(), &Counted(7)).unwrap();
    let received = other.receive(WATCHDOG).unwrap().expect("a message");
    assert_eq!((received.source(), received.decode::<Counted>().unwrap()), (one.tid(), Counted(7)));
    let told = thread::scope(|scope| {
        let (from, to) = (&mut one, other.tid());
        let sending = scope.spawn(move || from.send_confirmed(to, &Counted(8), WATCHDOG).unwrap());
        other.receive(WATCHDOG).unwrap().expect("a message").settle(Outcome::Failed);
        sending.join().unwrap()
    });
    assert_eq!(told, Outcome::Failed, "an outcome comes back on the link");
}

#[test]
fn messages_flow_on_a_link_while_the_node_does_nothing() {
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    // The node does not know the way to either of them any more.
    for tid in [one.tid(), other.tid()] {
        node.stores.router.remove_local(tid.app);
    }
    let to = other.tid();
    let asking = thread::spawn(move || {
        let reply: Counted = one.ask(to, &Counted(2), WATCHDOG).unwrap();
        reply
    });
    let request = other.receive(WATCHDOG).unwrap().expect("a request");
    other.reply(&request, &Counted(3)).unwrap();
    drop(request);
    assert_eq!(asking.join().unwrap(), Counted(3));
}

#[test]
fn who_only_sends_has_a_link_too() {
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    let deadline = Time::now() + WATCHDOG;
    while !has_link(&other, &one) {
        assert!(Time::now() < deadline, "waited for the link of one who only sends");
        one.send(other.tid(), &Counted(1)).unwrap();
        drop(other.receive(Duration::from_millis(1)).unwrap());
    }
}

#[test]
fn a_forged_source_costs_the_message_and_not_the_link() {
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    let third = endpoint(&node);
    link(&mut one, &mut other);
    for (source, destination) in [(third.tid(), other.tid()), (one.tid(), third.tid())] {
        let mut forged = Message::typed(source, destination, &Counted(1));
        forged.header.flags = Flags::CONFIRM;
        forged.header.correlation = 77;
        one.direct.open[0].writer.write(&forged).unwrap();
    }
    one.send(other.tid(), &Counted(2)).unwrap();
    let received = other.receive(WATCHDOG).unwrap().expect("a message");
    assert_eq!(received.decode::<Counted>().unwrap(), Counted(2), "the forged ones are not received");
    let link = &mut one.direct.open[0];
    let mut told = Vec::new();
    while told.len() < 2 {
        link.take().unwrap();
        while let Came::Message(message) = link.next().unwrap() {
            told.push((message.header.correlation, Outcome::from_code(message.payload[0])));
        }
    }
    let rejected = |why| (77, Some(Outcome::Rejected(why)));
    assert_eq!(told, [rejected(Rejection::ForgedSource), rejected(Rejection::Unsupported)]);
}

#[test]
fn a_peer_answers_for_itself_alone() {
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    let app = node.local(1);
    let (to, next) = (app.tid, one.correlation + 1);
    // Before the question is asked, somebody else has answered it.
    let mut header = Header::new(Kind::OUTCOME, other.tid(), one.tid());
    header.correlation = next;
    let forged = Message::new(header, bytes::Bytes::from_static(&[0]));
    other.direct.open[0].writer.write(&forged).unwrap();
    let told = thread::scope(|scope| {
        let asking = scope.spawn(|| one.send_confirmed(to, &Counted(1), WATCHDOG).unwrap());
        app.next().settle(Outcome::Failed);
        asking.join().unwrap()
    });
    assert_eq!(told, Outcome::Failed);
}

#[test]
fn what_is_no_frame_ends_the_link_and_the_node_goes_on() {
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    one.direct.open[0].writer.write_garbage();
    let deadline = Time::now() + WATCHDOG;
    while !(one.direct.open.is_empty() && other.direct.open.is_empty()) {
        assert!(Time::now() < deadline, "waited for the end of the link");
        assert!(other.receive(Duration::from_millis(1)).unwrap().is_none());
        assert!(one.receive(Duration::from_millis(1)).unwrap().is_none());
    }
    one.send(other.tid(), &Counted(3)).unwrap();
    assert!(other.receive(WATCHDOG).unwrap().is_some(), "through the node");
}

#[test]
fn a_descriptor_for_the_node_ends_its_senders_connection_in_words_and_is_closed() {
    let node = TestNode::start();
    let (mut hostile, mut other, mut third) = (endpoint(&node), endpoint(&node), endpoint(&node));
    link(&mut other, &mut third);
    let (kept, given) = UnixStream::pair().unwrap();
    let control = hostile.direct.control.clone().expect("the socket to the node");
    pass(&control, &given);
    drop(given);
    let error = hostile.receive(WATCHDOG).unwrap_err();
    assert!(error.to_string().contains("descriptors only"), "{error}");
    kept.set_read_timeout(Some(WATCHDOG)).unwrap();
    assert_eq!((&kept).read(&mut [0]).unwrap(), 0, "nobody has the other end");
    other.send(third.tid(), &Counted(1)).unwrap();
    assert!(third.receive(WATCHDOG).unwrap().is_some());
}

#[test]
fn what_the_node_says_of_links_that_are_none_changes_nothing() {
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    let lncl = payload::lncl_of(node.address());
    let told = Introduction { peer: other.tid().bits(), pid: 1, number: 999 };
    for kind in [Kind::LNCL_INTRODUCTION, Kind::LNCL_INTRODUCED] {
        node.stores.router.send(payload::frame(kind, lncl, one.tid(), &told)).unwrap();
    }
    let switch = Switch { peer: other.tid().bits(), number: 999 };
    node.stores.router.send(payload::frame(Kind::LNCL_SWITCH, other.tid(), one.tid(), &switch)).unwrap();
    let unreadable = Message::new(Header::new(Kind::LNCL_SWITCH, lncl, one.tid()), vec![0xc1].into());
    node.stores.router.send(unreadable).unwrap();
    other.send(one.tid(), &Counted(5)).unwrap();
    let received = one.receive(WATCHDOG).unwrap().expect("a message");
    assert_eq!(received.decode::<Counted>().unwrap(), Counted(5));
    assert!(has_link(&one, &other) && has_link(&other, &one));
}

/// Sends a descriptor where the protocol has none.
fn pass(socket: &UnixStream, descriptor: &UnixStream) {
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
    let mut control = SendAncillaryBuffer::new(&mut space);
    let descriptors = [descriptor.as_fd()];
    assert!(control.push(SendAncillaryMessage::ScmRights(&descriptors)));
    sendmsg(socket, &[IoSlice::new(&[0; 8])], &mut control, SendFlags::empty()).unwrap();
}

#[test]
fn each_class_comes_in_order_across_the_switch() {
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    let to = other.tid();
    let sending = thread::spawn(move || {
        let deadline = Time::now() + WATCHDOG;
        for number in 1..=2_000_u64 {
            // The first go through the node. The link stands before the last, however quick they are.
            while number == 1_000 && !one.direct.open.iter().any(|link| link.peer == to) {
                assert!(Time::now() < deadline, "waited for a link to {to}");
                assert!(one.receive(Duration::from_millis(1)).unwrap().is_none());
            }
            one.send(to, &Counted(number)).unwrap();
            one.send(to, &Hurried(number)).unwrap();
            // It has to look to learn that the link stands.
            assert!(one.receive(Duration::ZERO).unwrap().is_none());
        }
        one
    });
    let (mut counted, mut hurried) = (0, 0);
    let deadline = Time::now() + WATCHDOG * 3;
    while counted < 2_000 || hurried < 2_000 {
        assert!(Time::now() < deadline, "waited for 2,000 of each; {counted} and {hurried} have come");
        let Some(received) = other.receive(Duration::from_millis(10)).unwrap() else { continue };
        let (last, number) = if received.kind() == Counted::KIND {
            (&mut counted, received.decode::<Counted>().unwrap().0)
        } else {
            (&mut hurried, received.decode::<Hurried>().unwrap().0)
        };
        assert!(number > *last, "{number} came after {last}");
        *last = number;
    }
    let one = sending.join().unwrap();
    assert!(has_link(&other, &one), "they have switched");
}

/// Marks carry a number of their sender's, introductions one of LNCL's: neither is an answer to who waits for that number.
#[test]
fn a_link_is_made_while_one_side_waits_for_an_answer_by_the_same_number_as_the_link_is_talked_of() {
    for what_the_peer_says_next in [1, 2] {
        // given: one waits for an outcome
        let node = TestNode::start();
        let (mut one, mut other) = (endpoint(&node), endpoint(&node));
        let app = node.local(1);
        one.correlation = 40;
        // Its introduction is asked for by one number, its SWITCH is said by the next.
        other.correlation = 40 + 1 - what_the_peer_says_next;
        let (to, asked) = (one.tid(), app.tid);
        thread::scope(|scope| {
            let waiting = scope.spawn(|| one.send_confirmed(asked, &Counted(1), WATCHDOG).unwrap());
            let mut message = app.next();
            // when
            let deadline = Time::now() + WATCHDOG / 2;
            other.send(to, &Counted(2)).unwrap();
            while !other.direct.open.iter().any(|link| link.peer == to) {
                assert!(Time::now() < deadline, "waited for a link with {to}");
                drop(other.receive(Duration::from_millis(1)).unwrap());
            }
            // then
            message.settle(Outcome::Delivered);
            assert_eq!(waiting.join().unwrap(), Outcome::Delivered);
        });
    }
}

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
    let told = other.send_confirmed(gone, &Counted(4), WATCHDOG).unwrap();
    assert!(matches!(told, Outcome::Rejected(_)), "through the node again: {told:?}");
}

#[test]
fn what_one_life_of_an_address_wrote_into_its_ring_comes_before_what_the_next_one_sends_through_the_node() {
    // given
    let node = TestNode::start();
    let wanted = || Registration::new().direct(true).fixed(AppAddress::fixed(7).unwrap());
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
fn a_message_in_the_hand_of_a_peer_that_goes_has_failed() {
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    let to = other.tid();
    let sending = thread::spawn(move || one.send_confirmed(to, &Counted(1), WATCHDOG).unwrap());
    let in_hand = other.receive(WATCHDOG).unwrap().expect("a message");
    drop(other);
    assert_eq!(sending.join().unwrap(), Outcome::Failed);
    drop(in_hand);
}

#[test]
fn who_wants_no_links_has_none() {
    let node = TestNode::start();
    let mut one = endpoint(&node);
    let mut other = register(&node, Registration::new().direct(false));
    for _ in 0..20 {
        one.send(other.tid(), &Counted(1)).unwrap();
        drop(other.receive(WATCHDOG).unwrap().expect("a message"));
        other.send(one.tid(), &Counted(1)).unwrap();
        drop(one.receive(WATCHDOG).unwrap().expect("a message"));
    }
    assert!(one.direct.is_empty() && other.direct.is_empty());
}

#[test]
fn of_a_stream_the_newest_value_waits_for_room_in_the_ring() {
    let node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    // Nobody reads meanwhile, and nobody waits.
    for number in 1..=1_000 {
        one.send(other.tid(), &Setpoint(number)).unwrap();
    }
    let mut last = 0;
    let deadline = Time::now() + WATCHDOG;
    while last < 1_000 {
        assert!(Time::now() < deadline, "waited for the newest value; the last was {last}");
        drop(one.receive(Duration::ZERO).unwrap());
        let Some(received) = other.receive(Duration::from_millis(1)).unwrap() else { continue };
        let Setpoint(number) = received.decode().unwrap();
        assert!(number > last, "{number} came after {last}");
        last = number;
    }
}

#[test]
fn a_peer_that_takes_nothing_costs_a_sender_its_patience_and_not_the_link() {
    let node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let mut one = register(&node, Registration::new().direct(true).patience(Duration::from_millis(10)));
    let mut other = endpoint(&node);
    link(&mut one, &mut other);
    let mut taken = 0;
    let stalled = loop {
        match one.send(other.tid(), &Counted(taken)) {
            Ok(()) => taken += 1,
            Err(error) => break error,
        }
        assert!(taken < 4_096, "a ring of 4,096 bytes takes no end of messages");
    };
    assert!(matches!(stalled, ApiError::Stalled(_)), "{stalled}");
    for number in 0..taken {
        let received = other.receive(WATCHDOG).unwrap().expect("what was taken comes");
        assert_eq!(received.decode::<Counted>().unwrap(), Counted(number));
    }
    one.send(other.tid(), &Counted(taken)).unwrap();
    assert!(other.receive(WATCHDOG).unwrap().is_some());
}

#[test]
fn a_long_message_goes_in_pieces_through_a_short_ring() {
    let node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    let to = other.tid();
    let kind = Kind::named("test.long");
    let sending = thread::spawn(move || {
        let mut buffer = one.create_message(to, kind, 100_000).unwrap();
        buffer.fill(7);
        one.send_message(buffer).unwrap();
        one
    });
    let received = other.receive(WATCHDOG).unwrap().expect("a message");
    assert!(received.bytes().len() == 100_000 && received.bytes().iter().all(|byte| *byte == 7));
    sending.join().unwrap();
}

#[test]
fn two_that_wait_for_room_in_each_others_rings_take_in_what_is_there_meanwhile() {
    // given: rings that hold a fraction of what each sends before it receives anything
    let node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let wanted = || Registration::new().direct(true).patience(WATCHDOG / 2);
    let (mut one, mut other) = (register(&node, wanted()), register(&node, wanted()));
    link(&mut one, &mut other);
    let (one_tid, other_tid, number) = (one.tid(), other.tid(), one.direct.open[0].number);
    // when
    let exchange = |endpoint: &mut Endpoint, to| {
        for _ in 0..20 {
            let long = endpoint.create_message(to, Kind::named("test.long"), 20_000).unwrap();
            endpoint.send_message(long).unwrap();
        }
        for _ in 0..20 {
            assert_eq!(endpoint.receive(WATCHDOG).unwrap().expect("a message").bytes().len(), 20_000);
        }
    };
    thread::scope(|scope| {
        scope.spawn(|| exchange(&mut one, other_tid));
        exchange(&mut other, one_tid);
    });
    // then
    assert_eq!(one.direct.open[0].number, number, "nobody lost patience within a frame");
}

#[test]
fn of_a_long_message_that_a_peer_does_not_take_in_time_the_rest_goes_out_with_later_calls() {
    let node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let mut one = register(&node, Registration::new().direct(true).patience(Duration::from_millis(10)));
    let mut other = endpoint(&node);
    link(&mut one, &mut other);
    // when: nobody reads
    let mut long = one.create_message(other.tid(), Kind::named("test.long"), 20_000).unwrap();
    long.fill(7);
    one.send_message(long).unwrap();
    let stalled = one.send(other.tid(), &Counted(1)).unwrap_err();
    assert!(matches!(stalled, ApiError::Stalled(_)), "{stalled}");
    // then
    let deadline = Time::now() + WATCHDOG;
    let received = loop {
        assert!(Time::now() < deadline, "waited for the long message");
        assert!(one.receive(Duration::ZERO).unwrap().is_none());
        if let Some(received) = other.receive(Duration::from_millis(1)).unwrap() {
            break received;
        }
    };
    assert!(received.bytes().len() == 20_000 && received.bytes().iter().all(|byte| *byte == 7));
    assert!(has_link(&one, &other) && has_link(&other, &one), "the link has not ended");
    one.send(other.tid(), &Counted(2)).unwrap();
    assert_eq!(other.receive(WATCHDOG).unwrap().expect("a message").decode::<Counted>().unwrap(), Counted(2));
}

#[test]
fn links_are_bounded_and_what_is_above_goes_through_the_node() {
    use crate::api::routes::LINKS_MAX;
    let node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let mut hub = endpoint(&node);
    let mut others: Vec<_> = (0..=LINKS_MAX).map(|_| endpoint(&node)).collect();
    let deadline = Time::now() + WATCHDOG * 3;
    while hub.direct.open.len() < LINKS_MAX {
        assert!(Time::now() < deadline, "waited for {LINKS_MAX} links; there are {}", hub.direct.open.len());
        for other in &mut others {
            hub.send(other.tid(), &Counted(1)).unwrap();
            drop(other.receive(Duration::ZERO).unwrap());
            drop(hub.receive(Duration::ZERO).unwrap());
        }
    }
    for other in &mut others {
        hub.send(other.tid(), &Hurried(9)).unwrap();
        while other.receive(WATCHDOG).unwrap().expect("a message").kind() != Hurried::KIND {}
    }
    assert_eq!(hub.direct.open.len(), LINKS_MAX);
}

/// A message of a former life may be handled after one of this life. Both have the same source, destination and way.
#[test]
fn the_outcome_of_a_former_lifes_message_is_not_taken_for_one_of_this_life() {
    // given: a message of the former life waits to be received
    let node = TestNode::start();
    let wanted = || Registration::new().fixed(AppAddress::fixed(7).unwrap());
    let (former, mut other) = (register(&node, wanted()), register(&node, Registration::new()));
    let mut left = Message::typed(former.tid(), other.tid(), &Counted(1));
    (left.header.class, left.header.flags) = (Class::Bulk, Flags::CONFIRM);
    left.header.correlation = former.correlation + 1;
    former.writer.write(&left).unwrap();
    former.unregister().unwrap();
    // when
    let (mut next, to) = (register(&node, wanted()), other.tid());
    let asking = thread::spawn(move || next.send_confirmed(to, &Hurried(2), WATCHDOG).unwrap());
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
    let fixed = |index| Registration::new().direct(true).fixed(AppAddress::fixed(index).unwrap());
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
                Err(error) => assert!(matches!(error, ApiError::Away(_)), "{error}"),
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

#[test]
fn when_the_rings_of_a_process_have_their_most_in_bytes_messages_go_through_the_node() {
    let node = TestNode::start();
    let (mut one, mut other, mut third) = (endpoint(&node), endpoint(&node), endpoint(&node));
    // given: room for one ring of either
    let budgets = [&mut one, &mut other].map(|endpoint| {
        let budget = Box::leak(Box::new(Budget::new(endpoint.direct.terms.ring_bytes * 3 / 2)));
        endpoint.direct.terms.budget = budget;
        &*budget
    });
    link(&mut one, &mut other);
    assert!(budgets[0].held() > 0 && budgets[1].held() > 0);
    // when
    for _ in 0..20 {
        one.send(third.tid(), &Counted(1)).unwrap();
        drop(third.receive(WATCHDOG).unwrap().expect("a message"));
        third.send(other.tid(), &Counted(1)).unwrap();
        drop(other.receive(WATCHDOG).unwrap().expect("a message"));
    }
    // then
    assert_eq!((one.direct.open.len(), other.direct.open.len()), (1, 1));
    assert!(third.direct.is_empty());
    drop(one);
    let deadline = Time::now() + WATCHDOG;
    while !other.direct.is_empty() {
        assert!(Time::now() < deadline, "waited for the end of the link");
        assert!(other.receive(Duration::from_millis(1)).unwrap().is_none());
    }
    assert_eq!(budgets.map(Budget::held), [0, 0], "what a link took is given back");
}

#[test]
fn a_peer_that_takes_nothing_costs_a_sender_its_patience_once_and_not_with_each_message() {
    let node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let patience = WATCHDOG / 20;
    let mut one = register(&node, Registration::new().direct(true).patience(patience));
    let (mut other, mut third) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    while one.send(other.tid(), &Counted(1)).is_ok() {}
    // when
    let deadline = Time::now() + WATCHDOG;
    for number in 0..100 {
        assert!(
            Time::now() < deadline,
            "{number} messages were refused, and each after the sender's patience"
        );
        let refused = one.send(other.tid(), &Counted(2)).unwrap_err();
        assert!(matches!(refused, ApiError::Stalled(_)), "{refused}");
        // then: others are served
        one.send(third.tid(), &Counted(number)).unwrap();
        assert_eq!(
            third.receive(WATCHDOG).unwrap().expect("a message").decode::<Counted>().unwrap(),
            Counted(number)
        );
    }
    // It takes again, and is waited for again.
    while let Some(received) = other.receive(Duration::ZERO).unwrap() {
        drop(received);
    }
    one.send(other.tid(), &Counted(3)).unwrap();
    assert_eq!(other.receive(WATCHDOG).unwrap().expect("a message").decode::<Counted>().unwrap(), Counted(3));
}
