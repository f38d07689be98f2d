//! A node that stops: what waits goes out first, and what does not says so.

use std::collections::BTreeMap;

use sinew_runtime::{
    outcome::Outcome,
    tid::{Incarnation, Tid},
    time::Time,
    wire::{Class, Kind, Message},
};

use super::{
    bench::{ByHand, NINE, Node, introduction, next, pair, run, within},
    classes::lane_by_hand,
};
use crate::{
    clocks::{ClockDrift, ClockOffset},
    gncl::{
        LinkFact,
        core::{CLASSES, Introduction, Lane, read, write},
        peer::frame,
    },
    last_words::LastWords,
    session::Ack,
};

/// A connection for Bulk of a peer that has kept its memory, and takes the first message next.
async fn bulk_by_hand(node: &Node, dial: u64) -> ByHand {
    let mut lane = ByHand::dial(node).await;
    let features = vec![CLASSES.to_owned()];
    let hello = Introduction { lane: Lane::Bulk, link: 1, dial, features, ..introduction(node.address()) };
    lane.say(&frame(NINE, node.address(), Kind::GNCL_HELLO, write(&hello))).await;
    assert_eq!(lane.hear().await.header.kind, Kind::GNCL_WELCOME);
    let theirs = lane.try_hear_any().await.expect("the node says what it takes next");
    let Ack { epoch: of, .. } = read(&theirs.payload).expect("an ACK has a payload");
    let ours = Ack { memory: 1, epoch: 1, of, next: 1, change: 0, held: Vec::new(), room: None };
    lane.say(&frame(NINE, node.address(), Kind::GNCL_ACK, write(&ours))).await;
    lane
}

fn bulk(mut message: Message) -> Message {
    message.header.class = Class::Bulk;
    message
}

#[test]
fn what_waits_for_a_connection_that_a_link_still_lacks_goes_out_before_its_node_is_gone() {
    run(async {
        let mut node = Node::start(1).await;
        let mut first = lane_by_hand(&node, Lane::Control, 1).await;
        node.up().await;
        let to = Tid::new(NINE, node.tid(1).app);
        node.stores.router.send(bulk(node.message(to, b"before it is gone"))).expect("it waits");
        node.leave();
        assert_eq!(first.hear().await.header.kind, Kind::GNCL_GOODBYE);
        let mut last = lane_by_hand(&node, Lane::Bulk, 2).await;
        assert_eq!(last.hear().await.payload[..], *b"before it is gone");
        assert_eq!(last.hear().await.header.kind, Kind::GNCL_GOODBYE);
    });
}

#[test]
fn what_a_peer_has_not_said_to_have_goes_out_again_before_its_node_is_gone() {
    run(async {
        // Given: a message that was written, on a connection that breaks before anybody says that it has come
        let mut node = Node::start(1).await;
        let mut first = lane_by_hand(&node, Lane::Control, 1).await;
        node.up().await;
        let mut lost = bulk_by_hand(&node, 2).await;
        let to = Tid::new(NINE, node.tid(1).app);
        node.stores.router.send(bulk(node.message(to, b"written"))).expect("the peer is linked");
        assert_eq!(lost.hear().await.payload[..], *b"written");
        drop(lost);
        let peer = node.stores.gncl.peer(NINE).expect("it is linked");
        let way = peer.way(Lane::Bulk).expect("it has one for Bulk");
        within("the node to see that it is broken", async {
            while way.outlet.is_connected() {
                tokio::task::yield_now().await;
            }
        })
        .await;
        // When
        node.leave();
        assert_eq!(first.hear().await.header.kind, Kind::GNCL_GOODBYE);
        // Then
        let mut last = bulk_by_hand(&node, 3).await;
        assert_eq!(last.hear().await.payload[..], *b"written");
        assert_eq!(last.hear().await.header.kind, Kind::GNCL_GOODBYE);
    });
}

#[test]
fn what_was_written_on_a_connection_that_breaks_behind_the_goodbye_goes_out_again_before_its_node_is_gone() {
    run(async {
        // Given: a link that lacks nothing
        let mut node = Node::start(1).await;
        let mut first = lane_by_hand(&node, Lane::Control, 1).await;
        node.up().await;
        let _stream = lane_by_hand(&node, Lane::Stream, 2).await;
        let mut lost = bulk_by_hand(&node, 3).await;
        let to = Tid::new(NINE, node.tid(1).app);
        node.stores.router.send(bulk(node.message(to, b"written"))).expect("the peer is linked");
        assert_eq!(lost.hear().await.payload[..], *b"written");
        // When
        node.leave();
        assert_eq!(first.hear().await.header.kind, Kind::GNCL_GOODBYE);
        drop(lost);
        // Then
        let mut last = bulk_by_hand(&node, 4).await;
        assert_eq!(last.hear().await.payload[..], *b"written");
        assert_eq!(last.hear().await.header.kind, Kind::GNCL_GOODBYE);
    });
}

// spec: GNCL-10
#[test]
fn who_leaves_hears_that_its_last_message_was_taken_though_much_waits_for_it() {
    // Those that are written one by one, and those of which many are written at once.
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
            while node.stores.router.send(bulk(node.message(to, &long))).is_ok() {}
            // When
            let mut last = bulk(node.message(node.tid(1), b"the last word"));
            last.header.source.node = NINE;
            lane.say(&last).await;
            lane.say(&frame(NINE, node.address(), Kind::GNCL_GOODBYE, bytes::Bytes::new())).await;
            // Then
            let mut taken = 0;
            while let Some(heard) = lane.try_hear_any().await {
                if heard.header.kind == Kind::GNCL_ACK {
                    let Ack { next, .. } = read(&heard.payload).expect("an ACK has a payload");
                    taken = next;
                }
            }
            assert_eq!(taken, 2, "what it takes next is behind the last word: {length} bytes each");
            assert_eq!(next("the last word", &mut inbox).await.payload[..], *b"the last word");
        });
    }
}

#[test]
fn the_goodbye_of_a_node_that_gives_up_has_its_reason_and_is_told_with_it() {
    run(async {
        let words = LastWords::of("layers: more than 5 restarts");
        // Given: a peer that gives up
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        let goodbye =
            |fields: &BTreeMap<&str, &str>| frame(NINE, node.address(), Kind::GNCL_GOODBYE, write(fields));
        let bytes = goodbye(&[("gave_up", words.as_str())].into());
        peer.say(&bytes).await;
        // Then
        let left = node.fact_that(|fact| matches!(fact, LinkFact::PeerLeft { .. })).await;
        let gave_up = Some(words.clone());
        assert_eq!(left, LinkFact::PeerLeft { node: NINE, incarnation: Incarnation(1), gave_up });
        // Given: a node that gives up
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        node.stores.gave_up.get_or_init(|| words.clone());
        // When
        node.leave();
        // Then
        loop {
            let heard = peer.hear().await;
            if heard.header.kind == Kind::GNCL_GOODBYE {
                let fields: BTreeMap<String, String> = read(&heard.payload).expect("its reason");
                assert_eq!(fields["gave_up"], words.as_str());
                break;
            }
        }
    });
}

#[test]
fn what_is_known_of_the_clock_of_who_leaves_is_forgotten_with_it() {
    run(async {
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        let life = Incarnation(1);
        let (at, bound) = (Time::now(), std::time::Duration::ZERO);
        let offset = ClockOffset { theirs_minus_ours_ns: 0, bound, at, drift: ClockDrift::UNKNOWN };
        node.stores.clocks.set(NINE, life, offset);
        node.stores.gncl.leaves(Time::now(), NINE, life);
        assert!(node.stores.clocks.get(NINE, life).is_some(), "what it still sends has an age");
        peer.say(&frame(NINE, node.address(), Kind::GNCL_GOODBYE, bytes::Bytes::new())).await;
        node.fact_that(|fact| matches!(fact, LinkFact::PeerLeft { .. })).await;
        within("it to be forgotten", async {
            while node.stores.clocks.get(NINE, life).is_some() {
                tokio::task::yield_now().await;
            }
        })
        .await;
    });
}

#[test]
fn what_waits_for_a_peer_whose_link_is_broken_goes_out_on_the_next_one_before_its_node_is_gone() {
    run(async {
        let (mut a, mut b) = pair().await;
        let mut inbox = b.app(1);
        b.stop_layer();
        a.broken().await;
        a.send(b.tid(1), b"of Control");
        a.stores.router.send(bulk(a.message(b.tid(1), b"of Bulk"))).expect("it waits");
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
fn what_waits_for_a_peer_that_does_not_come_back_is_told_of_when_the_node_stops() {
    run(async {
        let mut node = Node::start(1).await;
        drop(ByHand::linked_to(&mut node).await);
        node.broken().await;
        let to = Tid::new(NINE, node.tid(1).app);
        node.stores.router.send(node.confirmed(to, 1)).expect("it waits");
        node.leave();
        assert_eq!(next("the outcome", &mut node.settled).await, (1, Outcome::PeerLost));
        node.ended().await;
        assert_eq!(node.stores.gncl.refusals.of("not delivered"), 1);
    });
}

#[test]
fn what_has_arrived_before_the_node_stops_is_told_of_to_nobody() {
    run(async {
        let (a, b) = pair().await;
        let mut inbox = b.app(1);
        for class in Class::ALL {
            let mut message = a.message(b.tid(1), b"arrived");
            message.header.class = class;
            a.stores.router.send(message).expect("the peer is linked");
        }
        a.leave();
        for _ in Class::ALL {
            assert_eq!(next("a message", &mut inbox).await.payload[..], *b"arrived");
        }
        a.ended().await;
        assert_eq!(a.stores.gncl.refusals.of("not delivered"), 0);
    });
}
