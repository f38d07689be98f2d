//! An incarnation of a peer that sent GOODBYE and continues to send: the time for which its messages are accepted. No
//! other incarnation is affected.

use std::{
    net::{IpAddr, Ipv4Addr, SocketAddr},
    sync::Arc,
    time::Duration,
};

use bytes::Bytes;
use futures_util::{FutureExt as _, Stream, StreamExt as _};
use sinew_runtime::{
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Header, Kind, Message},
};

use super::bench::{ByHand, NINE, Node, introduction, run};
use crate::{core::Introduction, outstanding::OutstandingDestinations};

const AGO: Duration = Duration::from_secs(5);
/// An address without a listener.
const NOWHERE: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 1);

/// Returns whether the node still accepts messages of the peer.
async fn is_heard(peer: &mut ByHand, node: &Node, inbox: &mut (impl Stream<Item = Message> + Unpin)) -> bool {
    let mut message = node.message(node.tid(1), b"still");
    message.header.source.node = NINE;
    peer.send(&message).await;
    // Read after the message: a message that is not there then was not accepted.
    let gncl = |node| Tid::new(node, AppAddress::GNCL);
    let ping = Header::new(Kind::GNCL_PING, gncl(NINE), gncl(node.address()));
    peer.send(&Message::new(ping, Bytes::new())).await;
    while peer.receive().await.header.kind != Kind::GNCL_PONG {}
    inbox.next().now_or_never().flatten().is_some()
}

#[test]
fn left_peer_is_accepted_until_its_time_is_over() {
    run(async {
        let mut node = Node::start(1).await;
        let mut inbox = node.app(1);
        let mut peer = ByHand::linked_to(&mut node).await;
        let incarnation = node.state.store.peer(NINE).expect("it is linked").incarnation;
        let state = node.state.clone();
        let store = &state.store;
        let left = Time::now();
        store.record_departure(left, NINE, incarnation);
        store.fence_departed(NINE, (left + AGO).shifted(-1), AGO);
        assert!(is_heard(&mut peer, &node, &mut inbox).await, "there is time yet");
        store.record_departure(left + AGO, NINE, incarnation);
        store.fence_departed(NINE, left + AGO, AGO);
        assert!(!is_heard(&mut peer, &node, &mut inbox).await);
    });
}

#[test]
fn later_incarnation_is_not_cut_for_its_predecessor() {
    run(async {
        // Given: the present incarnation of a node, which has not left.
        let mut node = Node::start(1).await;
        let mut inbox = node.app(1);
        let mut peer = ByHand::linked_to(&mut node).await;
        let incarnation = node.state.store.peer(NINE).expect("it is linked").incarnation;
        let (state, now) = (node.state.clone(), Time::now());
        let store = &state.store;

        // When: the time of the former one is over; then also when this one has just left.
        store.fence_departed(NINE, now, AGO);
        assert!(is_heard(&mut peer, &node, &mut inbox).await, "it has not left");
        store.record_departure(now, NINE, incarnation);
        store.fence_departed(NINE, now + AGO / 2, AGO);

        // Then:
        assert!(is_heard(&mut peer, &node, &mut inbox).await, "it has left just now");
    });
}

#[test]
fn peer_found_again_has_not_left() {
    run(async {
        let mut node = Node::start(1).await;
        let mut inbox = node.app(1);
        let mut peer = ByHand::linked_to(&mut node).await;
        let (state, left) = (node.state.clone(), Time::now());
        let store = &state.store;
        let incarnation = store.peer(NINE).expect("it is linked").incarnation;
        // Given: a goodbye in its name that was not its own.
        store.record_departure(left, NINE, incarnation);
        assert_eq!(store.outstanding(NINE), OutstandingDestinations::All);
        // When: it is found before its time is over.
        store.revoke_departure(NINE, incarnation);
        assert_eq!(store.outstanding(NINE), OutstandingDestinations::NONE);
        // Then: the end of that time has no effect.
        store.fence_departed(NINE, left + AGO, AGO);
        assert!(is_heard(&mut peer, &node, &mut inbox).await);
    });
}

#[test]
fn peer_found_after_being_given_up_relinks() {
    run(async {
        let mut node = Node::start(1).await;
        let mut inbox = node.app(1);
        let mut peer = ByHand::linked_to(&mut node).await;
        let (state, left) = (node.state.clone(), Time::now());
        let store = &state.store;
        let given_up = store.peer(NINE).expect("it is linked");
        store.record_departure(left, NINE, given_up.incarnation);
        store.fence_departed(NINE, left + AGO, AGO);
        assert!(!is_heard(&mut peer, &node, &mut inbox).await);
        // When
        node.find(NINE, NOWHERE);
        // Then: a peer with accepted messages takes its place.
        node.broken().await;
        drop(peer);
        let again = Introduction { dial: 2, ..introduction(node.address()) };
        let mut peer = ByHand::greeting(&node, &again).await;
        assert!(is_heard(&mut peer, &node, &mut inbox).await);
        assert!(!Arc::ptr_eq(&given_up, &store.peer(NINE).expect("it is linked")));
    });
}
