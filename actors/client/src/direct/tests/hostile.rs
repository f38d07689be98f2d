//! Input from a peer, a client or a node that no correct implementation sends.

use std::{
    io::{IoSlice, Read},
    mem::MaybeUninit,
    os::{fd::AsFd, unix::net::UnixStream},
};

use rustix::{
    io::Errno,
    net::{SendAncillaryBuffer, SendAncillaryMessage, SendFlags, send, sendmsg},
};
use sinew_protocol::payload::{self, Gone, Introduce, Introduction, Switch};
use sinew_runtime::wire::{Flags, Header, Message};

use super::*;
use crate::direct::{LinkRead, descriptors};

#[test]
fn forged_source_drops_message_and_keeps_link() {
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
    let (mut outcomes, deadline) = (Vec::new(), Time::now() + WATCHDOG);
    while outcomes.len() < 2 {
        assert!(Time::now() < deadline, "waited for the outcomes of the forged messages: {outcomes:?}");
        link.take().unwrap();
        while let LinkRead::Message(message) = link.next().unwrap() {
            outcomes.push((message.header.correlation, Outcome::from_code(message.payload[0])));
        }
    }
    let rejected = |why| (77, Some(Outcome::Rejected(why)));
    assert_eq!(outcomes, [rejected(Rejection::ForgedSource), rejected(Rejection::Unsupported)]);
}

#[test]
fn peer_cannot_answer_for_another() {
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    let app = node.local(1);
    let (to, next) = (app.tid, one.requests.correlation + 1);
    // Another peer answers the request before it is sent.
    let mut header = Header::new(Kind::OUTCOME, other.tid(), one.tid());
    header.correlation = next;
    let forged = Message::new(header, bytes::Bytes::from_static(&[0]));
    other.direct.open[0].writer.write(&forged).unwrap();
    let outcome = thread::scope(|scope| {
        let asking = scope.spawn(|| one.message(to, &Counted(1)).confirmed(WATCHDOG).unwrap());
        app.next().settle(Outcome::Failed);
        asking.join().unwrap()
    });
    assert_eq!(outcome, Outcome::Failed);
}

#[test]
fn malformed_frame_ends_link_but_not_node() {
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
fn descriptor_to_node_is_closed_and_ends_connection() {
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
    assert_eq!((&kept).read(&mut [0]).unwrap(), 0, "no process has the other end");
    other.send(third.tid(), &Counted(1)).unwrap();
    assert!(third.receive(WATCHDOG).unwrap().is_some());
}

// spec: LNCL-18
#[test]
fn kernel_refuses_descriptors_to_node_after_ring_setup() {
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    let (given, _kept) = UnixStream::pair().unwrap();
    if sinew_shm::set_descriptors(&given, sinew_shm::Descriptors::Refused).is_err() {
        // Kernels before 6.16: the previous test covers them.
        return;
    }
    let control = one.direct.control.clone().expect("the socket to the node");
    assert_eq!(try_pass(&control, &given), Err(Errno::PERM));
}

#[test]
fn reports_about_unknown_links_are_ignored() {
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    let lncl = payload::lncl_of(node.address());
    let introduction = Introduction { peer: other.tid().bits(), pid: 1, number: 999 };
    for kind in [Kind::LNCL_INTRODUCTION, Kind::LNCL_INTRODUCED] {
        node.router().send(payload::frame(kind, lncl, one.tid(), &introduction)).unwrap();
    }
    let switch = Switch { peer: other.tid().bits(), number: 999 };
    node.router().send(payload::frame(Kind::LNCL_SWITCH, other.tid(), one.tid(), &switch)).unwrap();
    let unreadable = Message::new(Header::new(Kind::LNCL_SWITCH, lncl, one.tid()), vec![0xc1].into());
    node.router().send(unreadable).unwrap();
    other.send(one.tid(), &Counted(5)).unwrap();
    let received = one.receive(WATCHDOG).unwrap().expect("a message");
    assert_eq!(received.decode::<Counted>().unwrap(), Counted(5));
    assert!(has_link(&one, &other) && has_link(&other, &one));
}

#[test]
fn refused_introduction_leaves_no_descriptor_in_socket() {
    // given: an endpoint that requests the link that it has again
    let node = TestNode::start();
    let (mut one, mut other) = (endpoint(&node), endpoint(&node));
    link(&mut one, &mut other);
    let app = node.local(1);
    let introduce = Introduce { to: other.tid().bits() };
    let lncl = payload::lncl_of(node.address());
    for _ in 0..3 {
        let again = payload::frame(Kind::LNCL_INTRODUCE, one.tid(), lncl, &introduce);
        assert!(one.node.writer.try_write(&again));
    }
    one.send(app.tid, &Urgent(1)).unwrap();
    drop(app.next());
    let control = other.direct.control.clone().expect("the socket to the node");
    assert!(descriptors::holds_data(&control), "ends of links are in transit");
    // when: it has received all frames sent before this one
    node.router().send(Message::typed(app.tid, other.tid(), &Urgent(2))).unwrap();
    while other.receive(WATCHDOG).unwrap().expect("a message").decode::<Urgent>().ok() != Some(Urgent(2)) {}
    // then
    assert!(!descriptors::holds_data(&control), "an end is left");
    assert!(has_link(&one, &other) && has_link(&other, &one));
}

// spec: LNCL-17
#[test]
fn send_only_endpoint_learns_end_of_stuck_peer() {
    // Given: a full link with a peer that reads nothing.
    let node = TestNode::start_with(|config| config.lncl.ring_bytes = 4_096);
    let mut one = register(&node, with_links().stall_timeout(Duration::from_millis(1)));
    let mut other = endpoint(&node);
    link(&mut one, &mut other);
    while one.send(other.tid(), &Counted(1)).is_ok() {}
    let number = one.direct.open[0].number;

    // When: the node reports that the peer is dead.
    let gone = Gone { peer: other.tid().bits(), number: number.0 };
    let lncl = payload::lncl_of(node.address());
    node.router().send(payload::frame(Kind::LNCL_GONE, lncl, one.tid(), &gone)).unwrap();

    // Then: further messages go through the node, here to the peer's next incarnation, which is already
    // registered.
    let deadline = Time::now() + WATCHDOG;
    while one.send(other.tid(), &Counted(2)).is_err() {
        assert!(Time::now() < deadline, "waited for the path through the node");
    }
}

/// Sends a descriptor where the protocol has none; bytes alone, if the system refuses descriptors (from Linux
/// 6.16 on).
fn pass(socket: &UnixStream, descriptor: &UnixStream) {
    match try_pass(socket, descriptor) {
        Err(Errno::PERM) => assert_eq!(send(socket, &[0; 8], SendFlags::empty()), Ok(8)),
        sent => assert_eq!(sent, Ok(8)),
    }
}

fn try_pass(socket: &UnixStream, descriptor: &UnixStream) -> Result<usize, Errno> {
    let mut space = [MaybeUninit::uninit(); rustix::cmsg_space!(ScmRights(1))];
    let mut control = SendAncillaryBuffer::new(&mut space);
    let descriptors = [descriptor.as_fd()];
    assert!(control.push(SendAncillaryMessage::ScmRights(&descriptors)));
    sendmsg(socket, &[IoSlice::new(&[0; 8])], &mut control, SendFlags::empty())
}
