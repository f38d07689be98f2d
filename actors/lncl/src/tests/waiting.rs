//! A client that waits at the barrier for its requirements.

use std::{
    io::{Read, Write},
    os::unix::net::UnixStream,
};

use bytes::BytesMut;
use sinew_protocol::{
    payload::{Refusal, Waiting},
    ring::Exchange,
};
use sinew_runtime::{
    lock,
    tid::NodeAddress,
    wire::{FrameCodec, encode_frame},
};
use tokio_util::codec::Decoder;

use super::*;

fn requiring(name: &str) -> Register {
    Register { requires: vec![name.to_owned()], ..Register::default() }
}

// spec: LNCL-6
#[test]
fn waiting_client_receives_its_missing_requirements_and_changes() {
    // Given: a client with a missing requirement.
    let mut node = TestNode::start();
    let names = node.with_names();
    let mut client = RawClient::connect(&node);
    client.ask_for_address(&Register { waits: true, ..requiring("hip") });
    let mut next = || {
        let frame = client.next().expect("what it waits for");
        assert_eq!(frame.header.kind, Kind::LNCL_WAITING, "{frame:?}");
        payload::read::<Waiting>(&frame.payload).unwrap().missing
    };
    assert_eq!(next(), [], "they are not known yet");

    // When: the sync manager is notified of it.
    let fact = node.fact();
    let AppFact::Registered { app, .. } = fact else { panic!("{fact:?} is no registration") };
    *lock(&names.missing) = vec![("hip".to_owned(), "not there")];

    // Then:
    let [missing] = &next()[..] else { panic!("one thing is missing") };
    assert_eq!(missing.what, "hip");
    assert!(!missing.why.is_empty());
    node.release(app);
    client.expect_registered();
}

// spec: LNCL-6
#[test]
fn long_list_of_missing_requirements_is_truncated() {
    let mut node = TestNode::start();
    let names = node.with_names();
    let mut client = RawClient::connect(&node);
    let requires = (0..64).map(|index| format!("{index:0>60} | x ?9s")).collect();
    client.ask_for_address(&Register { waits: true, requires, ..Register::default() });
    assert!(payload::read::<Waiting>(&client.next().expect("a frame").payload).unwrap().missing.is_empty());
    let fact = node.fact();
    assert!(matches!(fact, AppFact::Registered { .. }), "{fact:?}");
    *lock(&names.missing) = (0..64).map(|index| (format!("{index:0>60} | x ?9s"), "not there")).collect();
    let frame = client.next().expect("what it waits for");
    let missing = payload::read::<Waiting>(&frame.payload).unwrap().missing;
    assert!((1..64).contains(&missing.len()) && frame.payload.len() < 2_048, "{} bytes", frame.payload.len());
}

#[test]
fn client_is_held_until_all_its_requirements_are_ready() {
    let mut node = TestNode::start();
    let app = node.local(1);
    let mut client = RawClient::connect(&node);
    client.ask_for_address(&requiring("knee.sensor"));
    let AppFact::Registered { app: address, requires, .. } = node.fact() else { panic!("no registration") };
    assert_eq!(requires, ["knee.sensor"]);
    let early = node.send_confirmed(app.tid, Tid::new(node.address(), address), &Angle { degrees: 0.0 });
    assert_eq!(early.recv_timeout(WATCHDOG), Ok(Outcome::Rejected(Rejection::NoSuchApplication)));
    node.release(address);
    assert_eq!(client.expect_registered().app, address);
    assert_eq!(node.fact(), AppFact::Ready { app: address });
}

#[test]
fn client_may_leave_while_it_waits_at_the_barrier() {
    let mut node = TestNode::start();
    for sends_goodbye in [true, false] {
        let mut client = RawClient::connect(&node);
        client.ask_for_address(&requiring("knee.sensor"));
        let AppFact::Registered { app, .. } = node.fact() else { panic!("no registration") };
        if sends_goodbye {
            client
                .send(&Message::new(Header::new(Kind::LNCL_UNREGISTER, Tid::NONE, Tid::NONE), Bytes::new()));
            assert!(client.next().is_none());
        } else {
            drop(client);
        }
        assert_eq!(node.fact(), AppFact::Unregistered { app });
    }
}

// spec: LNCL-9
#[cfg(target_os = "linux")]
#[test]
fn client_stopped_before_its_rings_may_register_again() {
    // Given: a client that has its address.
    let mut node = TestNode::start();
    let mut client = UnixStream::connect(node.path()).unwrap();
    client.set_read_timeout(Some(WATCHDOG)).unwrap();
    let lncl = payload::lncl_of(NodeAddress::HERE);
    let asked =
        payload::frame(Kind::LNCL_REGISTER, Tid::NONE, lncl, &Register { ring: true, ..named("hip") });
    let mut bytes = BytesMut::new();
    encode_frame(&asked.header, &asked.payload, &mut bytes);
    client.write_all(&bytes).unwrap();
    assert_eq!(frame_in(&mut client).header.kind, Kind::LNCL_REGISTERED);
    // When: it does nothing until the node has given up.
    while !matches!(node.fact(), AppFact::Unregistered { .. }) {}
    // Then: after the node's own offer it reads that it may register again.
    assert!(Exchange::receive(&client).unwrap().is_some());
    let refusal: Refusal = payload::read(&frame_in(&mut client).payload).unwrap();
    assert!(refusal.again && refusal.sentence.contains("was stopped"), "{refusal:?}");
    let (_again, tid) = RawClient::register(&node, &named("hip"));
    assert_eq!(registrar::resolve(&node.state, "hip"), Some(tid));
}

/// Reads the next frame, and no byte more: descriptors may arrive with later bytes.
#[cfg(target_os = "linux")]
fn frame_in(client: &mut UnixStream) -> Message {
    let mut bytes = BytesMut::zeroed(HEADER_LEN);
    client.read_exact(&mut bytes).unwrap();
    let length = Header::payload_len(bytes.first_chunk().unwrap()).unwrap() as usize;
    bytes.resize(HEADER_LEN + length, 0);
    client.read_exact(&mut bytes[HEADER_LEN..]).unwrap();
    FrameCodec::new(length).decode(&mut bytes).unwrap().expect("a whole frame")
}
