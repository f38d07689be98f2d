//! Links that break, are made again, and end in order.

use std::sync::atomic::Ordering;

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    tid::Tid,
    wire::Kind,
};

use super::bench::{ByHand, Cable, NINE, Node, next, pair, run};
use crate::gncl::{LinkFact, peer::frame};

#[test]
fn two_nodes_that_find_each_other_at_once_have_one_link_and_use_it_both_ways() {
    run(async {
        let (a, b) = pair().await;
        let (mut at_a, mut at_b) = (a.app(1), b.app(1));
        for number in 0..100u8 {
            a.send(b.tid(1), &[number]);
            b.send(a.tid(1), &[number]);
        }
        for number in 0..100u8 {
            let there = next("a message at b", &mut at_b).await;
            assert_eq!((there.header.source, &there.payload[..]), (a.tid(1), &[number][..]));
            let here = next("a message at a", &mut at_a).await;
            assert_eq!((here.header.source, &here.payload[..]), (b.tid(1), &[number][..]));
        }
    });
}

#[test]
fn a_short_break_loses_nothing_that_was_not_sent_and_keeps_the_order() {
    run(async {
        let (mut a, b) = (Node::start(1).await, Node::start(2).await);
        let mut inbox = b.app(1);
        let cable = Cable::to(b.listens_at()).await;
        a.find(b.address(), cable.address);
        a.up().await;
        for round in 0..5u8 {
            for number in 0..50 {
                a.send(b.tid(1), &[round, number]);
            }
            for number in 0..25 {
                assert_eq!(next("a message", &mut inbox).await.payload[..], [round, number]);
            }
            for number in 25..50 {
                assert_eq!(next("a message", &mut inbox).await.payload[..], [round, number]);
            }
            cable.cut();
            a.broken().await;
        }
        for number in 0..50 {
            a.send(b.tid(1), &[99, number]);
        }
        for number in 0..50 {
            assert_eq!(next("a message after the last break", &mut inbox).await.payload[..], [99, number]);
        }
    });
}

#[test]
fn what_was_sent_and_not_confirmed_is_unknown_when_the_connection_ends() {
    run(async {
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        let to = Tid::new(NINE, node.tid(5).app);
        for correlation in [1, 2] {
            node.stores.router.send(node.confirmed(to, correlation)).unwrap();
        }
        let first = peer.hear().await;
        peer.hear().await;
        peer.say(&ByHand::outcome(&first, Outcome::Delivered)).await;
        assert_eq!(next("the first outcome", &mut node.settled).await, (1, Outcome::Delivered));
        drop(peer);
        assert_eq!(next("the second outcome", &mut node.settled).await, (2, Outcome::Unknown));
        node.broken().await;
    });
}

#[test]
fn a_lost_node_loses_what_waits_for_it_and_takes_nothing_more() {
    run(async {
        let mut node = Node::start(1).await;
        let peer = ByHand::linked_to(&mut node).await;
        drop(peer);
        node.broken().await;
        let to = Tid::new(NINE, node.tid(5).app);
        node.stores.router.send(node.confirmed(to, 1)).expect("it waits for the peer to come back");
        node.lose(NINE);
        assert_eq!(next("the outcome", &mut node.settled).await, (1, Outcome::PeerLost));
        assert_eq!(node.stores.router.send(node.message(to, b"")), Err(Rejection::NoSuchNode));
    });
}

#[test]
fn a_ping_is_answered() {
    run(async {
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        peer.say(&frame(NINE, node.address(), Kind::GNCL_PING, bytes::Bytes::new())).await;
        assert_eq!(peer.hear().await.header.kind, Kind::GNCL_PONG);
    });
}

#[test]
fn a_silent_peer_is_pinged() {
    run(async {
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        assert_eq!(peer.hear().await.header.kind, Kind::GNCL_PING);
    });
}

#[test]
fn a_node_that_leaves_says_goodbye_last_and_its_peer_knows_that_it_left() {
    run(async {
        let (mut a, mut b) = pair().await;
        let mut inbox = b.app(1);
        a.send(b.tid(1), b"the last word");
        a.stores.stopping.store(true, Ordering::Relaxed);
        a.stop_layer();
        assert_eq!(&next("the last word", &mut inbox).await.payload[..], b"the last word");
        let left = b.fact_that(|fact| !matches!(fact, LinkFact::LinkUp { .. })).await;
        assert!(matches!(left, LinkFact::PeerLeft { node, .. } if node == a.address()));
    });
}

#[test]
fn a_restarted_layer_listens_where_it_did_and_sends_what_waited_in_order() {
    run(async {
        let (mut a, mut b) = pair().await;
        let mut inbox = b.app(1);
        let before = a.listens_at();
        a.stop_layer();
        b.broken().await;
        for number in 0..20 {
            a.send(b.tid(1), &[number]);
        }
        a.start_layer().await;
        assert_eq!(a.listens_at(), before);
        for number in 0..20 {
            assert_eq!(next("a message that waited", &mut inbox).await.payload[..], [number]);
        }
    });
}

#[test]
fn two_layers_cannot_have_one_port_and_the_second_says_so() {
    run(async {
        let a = Node::start(1).await;
        let port = a.listens_at().port();
        let error = crate::gncl::listener::listen(([127, 0, 0, 1], port).into()).unwrap_err();
        assert_eq!(error.kind(), std::io::ErrorKind::AddrInUse);
    });
}
