//! Descriptors that take for ever to close, passed to a node that never asked for them, or asked for others. The test's process plays all:
//! what holds a thread up is let go by the test alone, after the newcomer was served.

use std::{net::TcpStream, os::fd::AsFd};

use rustix::{
    fs::{MemfdFlags, memfd_create},
    io::Errno,
    net::sockopt::set_socket_linger,
};

use super::*;
use crate::lingering::Lingering;

impl Lingering {
    /// Passes it and closes this copy. Where the system refuses it, it lingers no more.
    fn pass(&mut self, client: &mut RawClient, bytes: &[u8]) -> bool {
        let ours = self.ours.take().expect("it is passed once");
        let memory = memfd_create("some", MemfdFlags::CLOEXEC).unwrap();
        let passed = client.pass(bytes, &[ours.as_fd(), memory.as_fd()]);
        if let Err(error) = &passed {
            assert_eq!(error.raw_os_error(), Some(Errno::PERM.raw_os_error()), "{error}");
            set_socket_linger(&ours, None).unwrap();
        }
        close(ours);
        passed.is_ok()
    }

    /// Passes it to one who may have gone.
    fn pass_anyway(&mut self, client: &mut RawClient) {
        let ours = self.ours.take().expect("it is passed once");
        let _ = client.pass(b"S", &[ours.as_fd()]);
        close(ours);
    }
}

/// Closes a copy. It may be the last one: then nobody waits but the thread that does it, until it is let go.
fn close(ours: TcpStream) {
    std::thread::spawn(move || drop(ours));
}

fn with_rings() -> Register {
    Register { ring: true, ..Register::default() }
}

/// What a node offers to who asks for rings: it has some.
fn assert_gets_rings(node: &TestNode) {
    let mut client = RawClient::connect(node);
    client.ask_for_address(&with_rings());
    let registered: payload::Registered = payload::read(&client.next().expect("an answer").payload).unwrap();
    assert!(registered.ring.is_some(), "it gets rings");
}

/// The bytes of an offer with two descriptors: a ring of 4096 bytes, and futexes.
fn offer() -> Vec<u8> {
    [&b"SINEWSHM"[..], &2_u32.to_le_bytes(), &[1, 0, 0, 0], &4_096_u64.to_le_bytes()].concat()
}

// spec: LNCL-18
#[test]
fn a_stranger_that_passes_a_descriptor_that_does_not_close_holds_nobody_up() {
    let node = TestNode::start();
    let mut lingering = Lingering::new();
    let mut stranger = RawClient::connect(&node);
    // Where the system knows how, it does not let it come.
    lingering.pass(&mut stranger, b"S");
    assert_alive(&node);
    lingering.let_go();
}

// spec: LNCL-18
#[test]
fn where_descriptors_come_one_that_does_not_close_holds_nobody_up_and_is_refused() {
    let node = TestNode::start();
    node.stores.door.let_descriptors_come();
    // Given: one that was read with a descriptor beside it, and one that went before it was read.
    // The node refuses them itself as soon as it listens to a connection; so they come only to one that it has not seen yet.
    // What is passed is made before the connection: that takes longer than the node.
    let (mut stranger, first) = std::iter::repeat_with(Lingering::new)
        .take(100)
        .find_map(|mut lingering| {
            let mut stranger = RawClient::connect(&node);
            lingering.pass(&mut stranger, b"S").then_some((stranger, lingering))
        })
        .expect("one comes");
    let mut second = Lingering::new();
    let mut client = RawClient::connect(&node);
    client.send_bytes(&[b'x'; HEADER_LEN]);
    // The node may have refused it already.
    second.pass_anyway(&mut client);
    // Then:
    assert!(stranger.expect_refusal().contains("descriptors"));
    assert_alive(&node);
    assert_gets_rings(&node);
    assert!(node.refused("bad first frame") >= 1);
    [first, second].into_iter().for_each(Lingering::let_go);
}

// spec: LNCL-18
#[test]
fn an_offer_with_a_descriptor_that_does_not_close_costs_nobody_else_his_rings() {
    let node = TestNode::start();
    for bytes in [offer(), b"no offer".to_vec()] {
        let mut lingering = Lingering::new();
        let mut client = RawClient::connect(&node);
        client.ask_for_address(&with_rings());
        client.expect_registered();
        assert!(lingering.pass(&mut client, &bytes), "descriptors come when an offer is due");
        // The node's own offer is before it.
        client.skip_until_closed();
        assert_alive(&node);
        assert_gets_rings(&node);
        lingering.let_go();
    }
}
