//! A life of a peer that said goodbye and sends on: how long it is heard, and that no other life pays for it.

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
use crate::gncl::{core::Introduction, owed::Owed};

const AGO: Duration = Duration::from_secs(5);
/// An address at which nobody listens.
const NOWHERE: SocketAddr = SocketAddr::new(IpAddr::V4(Ipv4Addr::LOCALHOST), 1);

/// Whether the node still takes what the peer says.
async fn is_heard(peer: &mut ByHand, node: &Node, inbox: &mut (impl Stream<Item = Message> + Unpin)) -> bool {
    let mut message = node.message(node.tid(1), b"still");
    message.header.source.node = NINE;
    peer.say(&message).await;
    // Read behind it: what is not there then was not taken.
    let gncl = |node| Tid::new(node, AppAddress::GNCL);
    let ping = Header::new(Kind::GNCL_PING, gncl(NINE), gncl(node.address()));
    peer.say(&Message::new(ping, Bytes::new())).await;
    while peer.hear().await.header.kind != Kind::GNCL_PONG {}
    inbox.next().now_or_never().flatten().is_some()
}

#[test]
fn who_left_is_heard_for_so_long_after_its_first_goodbye_and_then_no_more() {
    run(async {
        let mut node = Node::start(1).await;
        let mut inbox = node.app(1);
        let mut peer = ByHand::linked_to(&mut node).await;
        let life = node.stores.gncl.peer(NINE).expect("it is linked").incarnation;
        let stores = node.stores.clone();
        let store = &stores.gncl;
        let left = Time::now();
        store.leaves(left, NINE, life);
        store.fence_who_left(NINE, (left + AGO).shifted(-1), AGO);
        assert!(is_heard(&mut peer, &node, &mut inbox).await, "there is time yet");
        store.leaves(left + AGO, NINE, life);
        store.fence_who_left(NINE, left + AGO, AGO);
        assert!(!is_heard(&mut peer, &node, &mut inbox).await);
    });
}

#[test]
fn a_later_life_is_not_cut_for_what_its_former_one_left() {
    run(async {
        // Given: the present life of a node, which has not left.
        let mut node = Node::start(1).await;
        let mut inbox = node.app(1);
        let mut peer = ByHand::linked_to(&mut node).await;
        let life = node.stores.gncl.peer(NINE).expect("it is linked").incarnation;
        let (stores, now) = (node.stores.clone(), Time::now());
        let store = &stores.gncl;

        // When: the time of the former one is over; then also when this one has just left.
        store.fence_who_left(NINE, now, AGO);
        assert!(is_heard(&mut peer, &node, &mut inbox).await, "it has not left");
        store.leaves(now, NINE, life);
        store.fence_who_left(NINE, now + AGO / 2, AGO);

        // Then:
        assert!(is_heard(&mut peer, &node, &mut inbox).await, "it has left just now");
    });
}

#[test]
fn who_is_found_again_has_not_left() {
    run(async {
        let mut node = Node::start(1).await;
        let mut inbox = node.app(1);
        let mut peer = ByHand::linked_to(&mut node).await;
        let (stores, left) = (node.stores.clone(), Time::now());
        let store = &stores.gncl;
        let life = store.peer(NINE).expect("it is linked").incarnation;
        // Given: a word in its name that it leaves, which was not its own.
        store.leaves(left, NINE, life);
        assert_eq!(store.owed(NINE), Owed::Anyone);
        // When: it is found before its time is over.
        store.stays(NINE, life);
        assert_eq!(store.owed(NINE), Owed::NOBODY);
        // Then: that time takes nothing.
        store.fence_who_left(NINE, left + AGO, AGO);
        assert!(is_heard(&mut peer, &node, &mut inbox).await);
    });
}

#[test]
fn who_is_found_when_it_was_given_up_has_another_link() {
    run(async {
        let mut node = Node::start(1).await;
        let mut inbox = node.app(1);
        let mut peer = ByHand::linked_to(&mut node).await;
        let (stores, left) = (node.stores.clone(), Time::now());
        let store = &stores.gncl;
        let given_up = store.peer(NINE).expect("it is linked");
        store.leaves(left, NINE, given_up.incarnation);
        store.fence_who_left(NINE, left + AGO, AGO);
        assert!(!is_heard(&mut peer, &node, &mut inbox).await);
        // When
        node.find(NINE, NOWHERE);
        // Then: a peer that can be heard takes its place.
        node.broken().await;
        drop(peer);
        let again = Introduction { dial: 2, ..introduction(node.address()) };
        let mut peer = ByHand::greeting(&node, &again).await;
        assert!(is_heard(&mut peer, &node, &mut inbox).await);
        assert!(!Arc::ptr_eq(&given_up, &store.peer(NINE).expect("it is linked")));
    });
}
