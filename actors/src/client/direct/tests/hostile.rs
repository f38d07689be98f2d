//! What a peer, a client or a node says that none of ours says.

use std::{
    io::{IoSlice, Read},
    mem::MaybeUninit,
    os::{fd::AsFd, unix::net::UnixStream},
};

use rustix::{
    io::Errno,
    net::{SendAncillaryBuffer, SendAncillaryMessage, SendFlags, send, sendmsg},
};
use sinew_runtime::wire::{Flags, Header, Message};

use super::*;
use crate::{
    client::direct::{Came, descriptors},
    lncl::payload::{self, Gone, Introduce, Introduction, Switch},
};

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
    let (mut told, deadline) = (Vec::new(), Time::now() + WATCHDOG);
    while told.len() < 2 {
        assert!(Time::now() < deadline, "waited for what became of the forged messages, told: {told:?}");
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
        let asking = scope.spawn(|| one.message(to, &Counted(1)).confirmed(WATCHDOG).unwrap());
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

// spec: LNCL-18
#[test]
fn once_the_rings_are_made_the_system_lets_no_descriptor_come_to_the_node() {
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    let (given, _kept) = UnixStream::pair().unwrap();
    if sinew_shm::set_descriptors(&given, sinew_shm::Descriptors::Refused).is_err() {
        // A kernel before 6.16: the test before this one says what becomes of it.
        return;
    }
    let control = one.direct.control.clone().expect("the socket to the node");
    assert_eq!(try_to_pass(&control, &given), Err(Errno::PERM));
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

#[test]
fn an_introduction_that_is_refused_leaves_nothing_in_the_socket() {
    // given: one that asks again for the link that it has
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    let app = node.local(1);
    let introduce = Introduce { to: other.tid().bits() };
    let lncl = payload::lncl_of(node.address());
    for _ in 0..3 {
        let again = payload::frame(Kind::LNCL_INTRODUCE, one.tid(), lncl, &introduce);
        assert!(one.writer.try_write(&again));
    }
    one.send(app.tid, &Hurried(1)).unwrap();
    drop(app.next());
    let control = other.direct.control.clone().expect("the socket to the node");
    assert!(descriptors::holds_something(&control), "ends of links are on their way");
    // when: all that was said before this has been heard
    node.stores.router.send(Message::typed(app.tid, other.tid(), &Hurried(2))).unwrap();
    while other.receive(WATCHDOG).unwrap().expect("a message").decode::<Hurried>().ok() != Some(Hurried(2)) {}
    // then
    assert!(!descriptors::holds_something(&control), "an end is left");
    assert!(has_link(&one, &other) && has_link(&other, &one));
}

// spec: LNCL-17
#[test]
fn who_only_sends_hears_of_the_end_of_a_peer_that_takes_nothing_and_whose_link_does_not_hang_up() {
    // Given: a link that is full, whose peer takes nothing.
    let node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let mut one = register(&node, Registration::new().direct(true).stall_timeout(Duration::from_millis(1)));
    let mut other = endpoint(&node);
    link(&mut one, &mut other);
    while one.send(other.tid(), &Counted(1)).is_ok() {}
    let number = one.direct.open[0].number;

    // When: the node says that it is dead.
    let gone = Gone { peer: other.tid().bits(), number: number.0 };
    let lncl = payload::lncl_of(node.address());
    node.stores.router.send(payload::frame(Kind::LNCL_GONE, lncl, one.tid(), &gone)).unwrap();

    // Then: what is sent goes through the node; here its next life is there already.
    let deadline = Time::now() + WATCHDOG;
    while one.send(other.tid(), &Counted(2)).is_err() {
        assert!(Time::now() < deadline, "waited for the way through the node");
    }
}

/// Sends a descriptor where the protocol has none; bytes alone, if the system lets none come (from Linux 6.16 on).
fn pass(socket: &UnixStream, descriptor: &UnixStream) {
    match try_to_pass(socket, descriptor) {
        Err(Errno::PERM) => assert_eq!(send(socket, &[0; 8], SendFlags::empty()), Ok(8)),
        sent => assert_eq!(sent, Ok(8)),
    }
}

fn try_to_pass(socket: &UnixStream, descriptor: &UnixStream) -> Result<usize, Errno> {
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
    let mut control = SendAncillaryBuffer::new(&mut space);
    let descriptors = [descriptor.as_fd()];
    assert!(control.push(SendAncillaryMessage::ScmRights(&descriptors)));
    sendmsg(socket, &[IoSlice::new(&[0; 8])], &mut control, SendFlags::empty())
}
