//! A node that stops: queued messages are sent first, and others are reported.

use std::collections::BTreeMap;

use sinew_model::{
    clocks::{ClockDrift, ClockOffset},
    facts::LinkFact,
    leave_reason::LeaveReason,
};
use sinew_runtime::{
    outcome::Outcome,
    tid::{Incarnation, Tid},
    time::Time,
    wire::{Class, Kind, Message},
};
use sinew_session::Ack;

use super::{
    bench::{ByHand, NINE, Node, introduction, next, pair, run, within},
    classes::lane_by_hand,
};
use crate::{
    core::{CLASSES, Introduction, Lane, read, write},
    frame::frame,
};

/// Opens a connection for Bulk of a peer that has kept its receive state, and expects the first message next.
async fn bulk_by_hand(node: &Node, dial: u64) -> ByHand {
    let mut lane = ByHand::dial(node).await;
    let features = vec![CLASSES.to_owned()];
    let hello = Introduction { lane: Lane::Bulk, link: 1, dial, features, ..introduction(node.address()) };
    lane.send(&frame(NINE, node.address(), Kind::GNCL_HELLO, write(&hello))).await;
    assert_eq!(lane.receive().await.header.kind, Kind::GNCL_WELCOME);
    let theirs = lane.try_receive_any().await.expect("the node says what it takes next");
    let Ack { epoch: of, .. } = read(&theirs.payload).expect("an ACK has a payload");
    let ours =
        Ack { receiver_id: 1, epoch: 1, peer_epoch: of, next: 1, change: 0, held: Vec::new(), room: None };
    lane.send(&frame(NINE, node.address(), Kind::GNCL_ACK, write(&ours))).await;
    lane
}

fn bulk(mut message: Message) -> Message {
    message.header.class = Class::Bulk;
    message
}

#[test]
fn messages_for_a_missing_connection_precede_the_end() {
    run(async {
        let mut node = Node::start(1).await;
        let mut first = lane_by_hand(&node, Lane::Control, 1).await;
        node.up().await;
        let to = Tid::new(NINE, node.tid(1).app);
        node.state.ctx.router.send(bulk(node.message(to, b"before it is gone"))).expect("it waits");
        node.leave();
        assert_eq!(first.receive().await.header.kind, Kind::GNCL_GOODBYE);
        let mut last = lane_by_hand(&node, Lane::Bulk, 2).await;
        assert_eq!(last.receive().await.payload[..], *b"before it is gone");
        assert_eq!(last.receive().await.header.kind, Kind::GNCL_GOODBYE);
    });
}

#[test]
fn unacknowledged_messages_are_sent_again_before_the_end() {
    run(async {
        // Given: a message was written, on a connection that breaks before it is acknowledged
        let mut node = Node::start(1).await;
        let mut first = lane_by_hand(&node, Lane::Control, 1).await;
        node.up().await;
        let mut lost = bulk_by_hand(&node, 2).await;
        let to = Tid::new(NINE, node.tid(1).app);
        node.state.ctx.router.send(bulk(node.message(to, b"written"))).expect("the peer is linked");
        assert_eq!(lost.receive().await.payload[..], *b"written");
        drop(lost);
        let peer = node.state.store.peer(NINE).expect("it is linked");
        let session = peer.session(Lane::Bulk).expect("it has one for Bulk");
        within("the node to see that it is broken", async {
            while session.outlet.is_connected() {
                tokio::task::yield_now().await;
            }
        })
        .await;
        // When
        node.leave();
        assert_eq!(first.receive().await.header.kind, Kind::GNCL_GOODBYE);
        // Then
        let mut last = bulk_by_hand(&node, 3).await;
        assert_eq!(last.receive().await.payload[..], *b"written");
        assert_eq!(last.receive().await.header.kind, Kind::GNCL_GOODBYE);
    });
}

#[test]
fn messages_on_a_connection_broken_after_goodbye_are_resent() {
    run(async {
        // Given: a link with all its connections
        let mut node = Node::start(1).await;
        let mut first = lane_by_hand(&node, Lane::Control, 1).await;
        node.up().await;
        let _stream = lane_by_hand(&node, Lane::Stream, 2).await;
        let mut lost = bulk_by_hand(&node, 3).await;
        let to = Tid::new(NINE, node.tid(1).app);
        node.state.ctx.router.send(bulk(node.message(to, b"written"))).expect("the peer is linked");
        assert_eq!(lost.receive().await.payload[..], *b"written");
        // When
        node.leave();
        assert_eq!(first.receive().await.header.kind, Kind::GNCL_GOODBYE);
        drop(lost);
        // Then
        let mut last = bulk_by_hand(&node, 4).await;
        assert_eq!(last.receive().await.payload[..], *b"written");
        assert_eq!(last.receive().await.header.kind, Kind::GNCL_GOODBYE);
    });
}

// spec: GNCL-10
#[test]
fn leaving_node_receives_its_last_acknowledgement() {
    // Messages written one by one, and messages written many at once.
    for (capacity, length) in [(64, 256 << 10), (8_192, 2 << 10)] {
        run(async {
            // Given: a peer that reads nothing until its socket is full
            let mut node = Node::start_with(1, |config| config.gncl.queue_capacity = capacity).await;
            let mut inbox = node.app(1);
            let _first = lane_by_hand(&node, Lane::Control, 1).await;
            node.up().await;
            let mut lane = bulk_by_hand(&node, 2).await;
            let to = Tid::new(NINE, node.tid(1).app);
            let long = vec![0; length];
            while node.state.ctx.router.send(bulk(node.message(to, &long))).is_ok() {}
            // When
            let mut last = bulk(node.message(node.tid(1), b"the last word"));
            last.header.source.node = NINE;
            lane.send(&last).await;
            lane.send(&frame(NINE, node.address(), Kind::GNCL_GOODBYE, bytes::Bytes::new())).await;
            // Then
            let mut taken = 0;
            while let Some(received) = lane.try_receive_any().await {
                if received.header.kind == Kind::GNCL_ACK {
                    let Ack { next, .. } = read(&received.payload).expect("an ACK has a payload");
                    taken = next;
                }
            }
            assert_eq!(taken, 2, "what it takes next is behind the last word: {length} bytes each");
            assert_eq!(next("the last word", &mut inbox).await.payload[..], *b"the last word");
        });
    }
}

#[test]
fn goodbye_after_giving_up_carries_the_reason() {
    run(async {
        let words = LeaveReason::of("layers: more than 5 restarts");
        // Given: a peer that gives up
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        let goodbye =
            |fields: &BTreeMap<&str, &str>| frame(NINE, node.address(), Kind::GNCL_GOODBYE, write(fields));
        let bytes = goodbye(&[("gave_up", words.as_str())].into());
        peer.send(&bytes).await;
        // Then
        let left = node.fact_that(|fact| matches!(fact, LinkFact::PeerLeft { .. })).await;
        let gave_up = Some(words.clone());
        assert_eq!(left, LinkFact::PeerLeft { node: NINE, incarnation: Incarnation(1), gave_up });
        // Given: a node that gives up
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        node.state.ctx.gave_up.get_or_init(|| words.clone());
        // When
        node.leave();
        // Then
        loop {
            let received = peer.receive().await;
            if received.header.kind == Kind::GNCL_GOODBYE {
                let fields: BTreeMap<String, String> = read(&received.payload).expect("its reason");
                assert_eq!(fields["gave_up"], words.as_str());
                break;
            }
        }
    });
}

#[test]
fn clock_of_a_leaving_node_is_forgotten() {
    run(async {
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        let incarnation = Incarnation(1);
        let (at, bound) = (Time::now(), std::time::Duration::ZERO);
        let offset = ClockOffset { theirs_minus_ours_ns: 0, bound, at, drift: ClockDrift::UNKNOWN };
        node.state.ctx.clocks.set(NINE, incarnation, offset);
        node.state.store.record_departure(Time::now(), NINE, incarnation);
        assert!(node.state.ctx.clocks.get(NINE, incarnation).is_some(), "what it still sends has an age");
        peer.send(&frame(NINE, node.address(), Kind::GNCL_GOODBYE, bytes::Bytes::new())).await;
        node.fact_that(|fact| matches!(fact, LinkFact::PeerLeft { .. })).await;
        within("it to be forgotten", async {
            while node.state.ctx.clocks.get(NINE, incarnation).is_some() {
                tokio::task::yield_now().await;
            }
        })
        .await;
    });
}

#[test]
fn messages_for_a_broken_link_use_the_next_one() {
    run(async {
        let (mut a, mut b) = pair().await;
        let mut inbox = b.app(1);
        b.stop_layer();
        a.broken().await;
        a.send(b.tid(1), b"of Control");
        a.state.ctx.router.send(bulk(a.message(b.tid(1), b"of Bulk"))).expect("it waits");
        a.leave();
        b.start_layer().await;
        let mut came = Vec::new();
        for _ in 0..2 {
            came.push(next("what waited", &mut inbox).await.payload);
        }
        came.sort();
        assert_eq!(came, [&b"of Bulk"[..], b"of Control"]);
    });
}

#[test]
fn messages_for_an_absent_peer_are_reported() {
    run(async {
        let mut node = Node::start(1).await;
        drop(ByHand::linked_to(&mut node).await);
        node.broken().await;
        let to = Tid::new(NINE, node.tid(1).app);
        node.state.ctx.router.send(node.confirmed(to, 1)).expect("it waits");
        node.leave();
        assert_eq!(next("the outcome", &mut node.settled).await, (1, Outcome::PeerLost));
        node.ended().await;
        assert_eq!(node.state.store.refusals.of("not delivered"), 1);
    });
}

#[test]
fn messages_received_before_the_stop_are_not_reported() {
    run(async {
        let (a, b) = pair().await;
        let mut inbox = b.app(1);
        for class in Class::ALL {
            let mut message = a.message(b.tid(1), b"arrived");
            message.header.class = class;
            a.state.ctx.router.send(message).expect("the peer is linked");
        }
        a.leave();
        for _ in Class::ALL {
            assert_eq!(next("a message", &mut inbox).await.payload[..], *b"arrived");
        }
        a.ended().await;
        assert_eq!(a.state.store.refusals.of("not delivered"), 0);
    });
}
