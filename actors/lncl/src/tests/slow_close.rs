//! Descriptors that take forever to close, passed to a node that did not request them, or requested others.
//! The test's process plays all parts. Only the test releases a blocked thread, after the newcomer was
//! served.

use std::{net::TcpStream, os::fd::AsFd};

use rustix::{
    fs::{MemfdFlags, memfd_create},
    io::Errno,
    net::sockopt::set_socket_linger,
};

use super::*;
use crate::slow_close::SlowClose;

impl SlowClose {
    /// Passes the descriptor and closes this copy. If the system refuses it, its close no longer blocks.
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

    /// Passes the descriptor to a client that may have ended.
    fn try_pass(&mut self, client: &mut RawClient) {
        let ours = self.ours.take().expect("it is passed once");
        let _ = client.pass(b"S", &[ours.as_fd()]);
        close(ours);
    }
}

/// Closes a copy. It may be the last one: then only the closing thread waits, until it is released.
fn close(ours: TcpStream) {
    std::thread::spawn(move || drop(ours));
}

fn with_rings() -> Register {
    Register { ring: true, ..Register::default() }
}

/// Checks that the node offers rings to a client that requests them.
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
fn unregistered_clients_slow_descriptor_delays_no_client() {
    let node = TestNode::start();
    let mut slow = SlowClose::new();
    let mut unregistered = RawClient::connect(&node);
    // A system that supports it does not let the descriptor in.
    slow.pass(&mut unregistered, b"S");
    assert_alive(&node);
    slow.release();
}

// spec: LNCL-18
#[test]
fn received_slow_descriptor_is_refused_without_delay() {
    let node = TestNode::start();
    node.state.client_socket.accept_descriptors();
    // Given: one that was read with a descriptor, and one that went before it was read. The node refuses
    // descriptors as soon as it listens to a connection, so they only arrive on a new one. The passed
    // descriptors are made before the connection, as that takes longer than the node's accept.
    let (mut unregistered, first) = std::iter::repeat_with(SlowClose::new)
        .take(100)
        .find_map(|mut slow| {
            let mut unregistered = RawClient::connect(&node);
            slow.pass(&mut unregistered, b"S").then_some((unregistered, slow))
        })
        .expect("one comes");
    let mut second = SlowClose::new();
    let mut client = RawClient::connect(&node);
    client.send_bytes(&[b'x'; HEADER_LEN]);
    // The node may have refused it already.
    second.try_pass(&mut client);
    // Then:
    assert!(unregistered.expect_refusal().contains("descriptors"));
    assert_alive(&node);
    assert_gets_rings(&node);
    assert!(node.refused("bad first frame") >= 1);
    [first, second].into_iter().for_each(SlowClose::release);
}

// spec: LNCL-18
#[test]
fn offer_with_slow_descriptor_costs_no_other_rings() {
    let node = TestNode::start();
    for bytes in [offer(), b"no offer".to_vec()] {
        let mut slow = SlowClose::new();
        let mut client = RawClient::connect(&node);
        client.ask_for_address(&with_rings());
        client.expect_registered();
        assert!(slow.pass(&mut client, &bytes), "descriptors come when an offer is due");
        // The node's own offer comes first.
        client.skip_until_closed();
        assert_alive(&node);
        assert_gets_rings(&node);
        slow.release();
    }
}
