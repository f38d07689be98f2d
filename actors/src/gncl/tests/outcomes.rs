//! Several outcomes in one frame, between two nodes that know that. spec: GNCL-17

use bytes::Bytes;
use sinew_runtime::{
    outcome::{Outcome, Rejection},
    tid::{AppAddress, Tid},
    wire::{Kind, Message},
};

use super::bench::{ByHand, NINE, Node, introduction, next, pair, run};
use crate::gncl::{core::Introduction, peer::frame};

/// What peer 9 says of messages from the application 1 of node 1 to its own application 1: one frame, its bytes by hand.
fn said(outcomes: &[(u64, u8)]) -> Message {
    let mut payload = Vec::new();
    for (correlation, code) in outcomes {
        payload.extend([0x01, 0x10, 0, 0, 0x01, 0x10, 0, 0]);
        payload.extend(correlation.to_le_bytes());
        payload.push(*code);
    }
    from_nine(payload)
}

fn from_nine(payload: Vec<u8>) -> Message {
    frame(NINE, sinew_runtime::tid::NodeAddress::new(1), Kind::GNCL_OUTCOMES, Bytes::from(payload))
}

/// A node with a peer by hand that has `count` confirmed messages of it, numbered from 1.
async fn owing(count: u64) -> (Node, ByHand) {
    let mut node = Node::start(1).await;
    let mut peer = ByHand::linked_to(&mut node).await;
    for correlation in 1..=count {
        let to = Tid::new(NINE, AppAddress::new(0x1001));
        node.stores.router.send(node.confirmed(to, correlation)).unwrap();
        assert_eq!(peer.hear().await.header.correlation, correlation);
    }
    (node, peer)
}

#[test]
fn each_outcome_of_a_frame_is_told_and_one_that_is_none_spoils_its_own_alone() {
    run(async {
        let (mut node, mut peer) = owing(4).await;
        peer.say(&said(&[(2, 0), (1, 2), (77, 0), (3, 200), (4, 20)])).await;
        let full = Outcome::Rejected(Rejection::QueueFull);
        for expected in [(2, Outcome::Delivered), (1, Outcome::Failed), (4, full)] {
            assert_eq!(next("an outcome", &mut node.settled).await, expected);
        }
        node.counted("no such outcome").await;
        let peer = node.stores.gncl.peer(NINE).expect("it is linked");
        assert_eq!(peer.unconfirmed(), 1, "the third waits for its outcome");
    });
}

#[test]
fn outcomes_that_are_not_whole_or_too_many_or_none_end_the_connection_in_words() {
    for length in [0, 16, 18, 17 * 129] {
        run(async move {
            let (_node, mut peer) = owing(1).await;
            peer.say(&from_nine(vec![0; length])).await;
            let refusal = peer.refusal().await;
            assert_eq!(refusal.cause, "violation", "{length} bytes: {refusal:?}");
        });
    }
}

#[test]
fn a_node_says_that_it_takes_them_and_sends_them_to_nobody_else() {
    run(async {
        // Given a peer that takes each by itself and one that takes several, each of which has sent much that is confirmed.
        for knows in [false, true] {
            let node = Node::start(1).await;
            let mut inbox = node.app(1);
            let features = if knows { vec!["outcomes".to_owned()] } else { Vec::new() };
            let mut peer =
                ByHand::greeting(&node, &Introduction { features, ..introduction(node.address()) }).await;
            for correlation in 1..=64 {
                let mut message = node.message(node.tid(1), b"");
                message.header.source.node = NINE;
                message.header.flags = sinew_runtime::wire::Flags::CONFIRM;
                message.header.correlation = correlation;
                peer.say(&message).await;
            }
            // When they are taken as fast as that goes.
            let mut taken = Vec::new();
            for _ in 0..64 {
                taken.push(next("a message", &mut inbox).await);
            }
            for mut message in taken {
                message.settle(Outcome::Delivered);
            }
            // Then each outcome comes once, and only one of them has frames of several.
            let (mut told, mut frames) = (0, 0);
            while told < 64 {
                let message = peer.hear().await;
                frames += 1;
                told += match message.header.kind {
                    Kind::GNCL_OUTCOMES => message.payload.len() / 17,
                    _ => 1,
                };
            }
            assert_eq!((told, frames < 64), (64, knows), "{frames} frames");
        }
    });
}

#[test]
fn a_flood_of_confirmed_messages_between_two_nodes_has_each_outcome_once() {
    run(async {
        let (mut a, b) = pair().await;
        let mut inbox = b.app(1);
        for correlation in 1..=1_000 {
            a.stores.router.send(a.confirmed(b.tid(1), correlation)).unwrap();
        }
        for _ in 0..1_000 {
            next("a message", &mut inbox).await.settle(Outcome::Delivered);
        }
        let mut told = Vec::new();
        for _ in 0..1_000 {
            let (correlation, outcome) = next("an outcome", &mut a.settled).await;
            assert_eq!(outcome, Outcome::Delivered);
            told.push(correlation);
        }
        assert_eq!(told, (1..=1_000).collect::<Vec<_>>(), "in the order in which they were said");
    });
}
