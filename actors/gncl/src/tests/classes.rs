//! Connections per class: each is independent of the others.

use sinew_model::facts::LinkFact;
use sinew_runtime::{
    outcome::{Outcome, Rejection},
    wire::{Class, Kind, Message},
};

use super::bench::{ByHand, Cable, NINE, Node, introduction, next, pair, run};
use crate::core::{CLASSES, Introduction, Lane};

pub(super) fn of_class(class: Class, mut message: Message) -> Message {
    message.header.class = class;
    message
}

/// Opens the connection of `lane` to `node`, from a peer that has one per class.
pub(super) async fn lane_by_hand(node: &Node, lane: Lane, dial: u64) -> ByHand {
    let link = if lane == Lane::Control { 0 } else { 1 };
    let features = vec![CLASSES.to_owned()];
    ByHand::greeting(node, &Introduction { lane, link, dial, features, ..introduction(node.address()) }).await
}

#[test]
fn each_class_travels_on_its_own_connection() {
    run(async {
        let mut node = Node::start(1).await;
        let first = lane_by_hand(&node, Lane::Control, 1).await;
        node.up().await;
        let stream = lane_by_hand(&node, Lane::Stream, 2).await;
        let bulk = lane_by_hand(&node, Lane::Bulk, 3).await;
        let mut message = node.message(node.tid(1), b"to nine");
        message.header.destination.node = NINE;
        let mut lanes = [first, stream, bulk];
        for (class, lane) in Class::ALL.into_iter().zip(&mut lanes) {
            let copy = Message::new(message.header, message.payload.clone());
            node.state.ctx.router.send(of_class(class, copy)).expect("the peer is linked");
            let there = lane.receive().await.header;
            assert_eq!((there.class, there.number), (class, 1), "each has its own numbers");
        }
    });
}

#[test]
fn too_long_message_is_refused_before_its_connection_exists() {
    run(async {
        let mut node = Node::start(1).await;
        let features = vec![CLASSES.to_owned()];
        let hello = Introduction { features, payload_max: 64, ..introduction(node.address()) };
        let _control = ByHand::greeting(&node, &hello).await;
        node.up().await;
        let mut to = node.tid(1);
        to.node = NINE;
        for class in Class::ALL {
            let refused = node.state.ctx.router.send(of_class(class, node.message(to, &[0; 65])));
            assert_eq!(refused, Err(Rejection::TooLong), "{class:?}");
        }
    });
}

#[test]
fn control_arrives_while_bulk_is_not_read() {
    run(async {
        let mut node = Node::start_with(1, |config| config.gncl.queue_capacity = 64).await;
        let mut first = lane_by_hand(&node, Lane::Control, 1).await;
        node.up().await;
        let _never_read = lane_by_hand(&node, Lane::Bulk, 2).await;
        let mut to = node.tid(1);
        to.node = NINE;
        let long = vec![0; 1 << 20];
        // Sends until the socket and the queue before it are full.
        while node.state.ctx.router.send(of_class(Class::Bulk, node.message(to, &long))).is_ok() {}
        node.send(to, b"in time");
        let mut received = first.receive().await;
        while received.header.kind == Kind::GNCL_PING {
            // Filling the other one took long.
            received = first.receive().await;
        }
        assert_eq!(received.payload[..], *b"in time");
    });
}

#[test]
fn refused_bulk_flood_ends_that_connection_alone() {
    run(async {
        let mut node = Node::start(1).await;
        let mut first = lane_by_hand(&node, Lane::Control, 1).await;
        node.up().await;
        let mut bulk = lane_by_hand(&node, Lane::Bulk, 2).await;
        bulk.send_bytes(&[0xFF; 1_000]).await;
        assert_eq!(bulk.receive().await.header.kind, Kind::GNCL_REFUSAL);
        // Several turns of a reader, which pauses between two of them.
        bulk.send_bytes(&[7; 512 << 10]).await;
        assert!(bulk.try_receive().await.is_none(), "the node has said its last word on it");
        drop(bulk);
        // The link is up: after the end of that connection the node accepts another one for Bulk.
        let mut again = lane_by_hand(&node, Lane::Bulk, 3).await;
        let mut to = node.tid(1);
        to.node = NINE;
        node.state
            .ctx
            .router
            .send(of_class(Class::Bulk, node.message(to, b"Bulk")))
            .expect("the peer is linked");
        assert_eq!(again.receive().await.payload[..], *b"Bulk");
        node.send(to, b"Control");
        assert_eq!(first.receive().await.payload[..], *b"Control");
    });
}

#[test]
fn broken_bulk_connection_leaves_the_link_and_loses_nothing() {
    run(async {
        let (mut a, b) = (Node::start(1).await, Node::start(2).await);
        let mut inbox = b.app(1);
        let cable = Cable::to(b.listens_at()).await;
        a.find(b.address(), cable.address);
        a.up().await;
        let mut number = 0u64;
        // Connections 1 and 2 are the first of the further ones; each cut one is followed by another.
        for cut in 1..8 {
            for _ in 0..100 {
                number += 1;
                let message = a.message(b.tid(1), &number.to_le_bytes());
                a.state.ctx.router.send(of_class(Class::Bulk, message)).expect("there is room for it");
            }
            cable.cut_one(cut);
            for expected in number - 99..=number {
                let message = next("a message of Bulk", &mut inbox).await;
                assert_eq!(message.payload[..], expected.to_le_bytes());
            }
        }
        a.send(b.tid(1), b"Control");
        next("a message of Control", &mut inbox).await;
        a.lose(b.address());
        let fact = a.fact().await;
        assert!(matches!(fact, LinkFact::LinkBroken { .. }), "{fact:?} is the first since the link stood");
    });
}

#[test]
fn outcome_of_any_class_reaches_its_message() {
    run(async {
        let (mut a, b) = pair().await;
        let mut inbox = b.app(1);
        for (correlation, class) in [(1, Class::Control), (2, Class::Bulk)] {
            a.state.ctx.router.send(of_class(class, a.confirmed(b.tid(1), correlation))).unwrap();
            let message = next("the message", &mut inbox).await;
            message.receipt.expect("it is to be confirmed").settle(Outcome::Delivered);
            assert_eq!(next("its outcome", &mut a.settled).await, (correlation, Outcome::Delivered));
        }
    });
}
