//! Several outcomes in one frame, between two nodes that know that. spec: GNCL-17

use bytes::Bytes;
use sinew_runtime::{
    outcome::{Outcome, ReceiptSink as _, Rejection, Ticket},
    tid::{AppAddress, Tid},
    wire::{Kind, Message},
};

use super::{
    bench::{ByHand, NINE, Node, introduction, next, pair, run, within},
    classes::lane_by_hand,
};
use crate::gncl::{
    core::{Introduction, Lane},
    peer::frame,
    way::answers_max,
};

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

/// What is said to the sender of each of `count` confirmed messages, to two applications in turn, if all that come are handled while there
/// is no connection: by correlation, all that was said of it.
async fn told_by_nodes_with_queues_of(sender: usize, receiver: usize, count: u64) -> Vec<Vec<Outcome>> {
    let with =
        |number, capacity| Node::start_with(number, move |config| config.gncl.queue_capacity = capacity);
    let (mut a, mut b) = (with(1, sender).await, with(2, receiver).await);
    a.find(b.address(), b.listens_at());
    b.find(a.address(), a.listens_at());
    a.up().await;
    b.up().await;
    let mut inboxes = [b.app(1), b.app(2)];
    let mut taken = Vec::new();
    for correlation in 0..count {
        let to = correlation as usize % 2;
        let confirmed = a.confirmed(b.tid(1 + to as u32), correlation);
        if a.stores.router.send(confirmed).is_ok() {
            taken.push(next("a message", &mut inboxes[to]).await);
        }
    }
    b.stop_layer();
    for mut message in taken {
        message.settle(Outcome::Delivered);
    }
    b.start_layer().await;
    b.find(a.address(), a.listens_at());
    let mut told = vec![Vec::new(); count as usize];
    for _ in 0..count {
        let (correlation, outcome) = next("an outcome", &mut a.settled).await;
        told[correlation as usize].push(outcome);
    }
    let dropped = b.stores.gncl.refusals.of("own frame not sent");
    assert_eq!(dropped, 0, "outcomes of a queue of {sender} at one of {receiver}");
    let peer = a.stores.gncl.peer(b.address()).expect("it is linked");
    assert_eq!(peer.unconfirmed(), 0);
    told
}

// spec: GNCL-12
#[test]
fn each_confirmed_message_has_one_outcome_also_where_two_nodes_queues_are_not_equal() {
    const COUNT: u64 = 1_500;
    run(async {
        for (sender, receiver) in [(1_024, 1), (1, 1_024), (1, 1), (65_536, 1), (1_024, 1_024)] {
            let told = told_by_nodes_with_queues_of(sender, receiver, COUNT).await;
            let full = Outcome::Rejected(Rejection::QueueFull);
            let is_one = |told: &Vec<Outcome>| *told == [Outcome::Delivered] || *told == [full];
            assert!(told.iter().all(is_one), "{sender} to {receiver}: {told:?}");
            let delivered = told.iter().filter(|told| **told == [Outcome::Delivered]).count() as u64;
            // A queue of one has one of each destination open.
            assert_eq!(delivered, if sender == 1 { 2 } else { COUNT }, "{sender} to {receiver}");
        }
    });
}

// spec: GNCL-12
#[test]
fn no_more_is_open_than_the_peer_has_room_for_answers() {
    run(async {
        let node = Node::start(1).await;
        let hello = Introduction { answers_max: 3, ..introduction(node.address()) };
        let mut peer = ByHand::greeting(&node, &hello).await;
        let send = |correlation: u64| {
            // To several applications: of each alone there would be room for more.
            let to = Tid::new(NINE, AppAddress::new(0x1000 + correlation as u32));
            node.stores.router.send(node.confirmed(to, correlation))
        };
        within("the peer to be known", async {
            while node.stores.gncl.peer(NINE).is_none() {
                tokio::task::yield_now().await;
            }
        })
        .await;
        for correlation in 1..=3 {
            send(correlation).expect("there is room for its answer");
        }
        assert!(send(4).is_err(), "there is none");
        let first = peer.hear().await;
        peer.say(&ByHand::outcome(&first, Outcome::Delivered)).await;
        within("the outcome", async {
            while node.stores.gncl.peer(NINE).is_some_and(|peer| peer.unconfirmed() == 3) {
                tokio::task::yield_now().await;
            }
        })
        .await;
        send(5).expect("there is room for its answer");
        assert!(send(6).is_err(), "there is none again");
    });
}

// spec: GNCL-12
#[test]
fn an_application_that_never_answers_takes_no_room_for_answers_from_another_one_of_its_node() {
    run(async {
        // Given a queue that is longer than all the room of the peer, which is what nodes say whose queue is no longer than usual.
        const THERE: u64 = 8_192;
        const OTHERS: u64 = 1_000_000;
        let mut node = Node::start_with(1, |config| config.gncl.queue_capacity = 65_536).await;
        let hello = Introduction { answers_max: THERE, ..introduction(node.address()) };
        let mut peer = ByHand::greeting(&node, &hello).await;
        within("the peer to be known", async {
            while node.stores.gncl.peer(NINE).is_none() {
                tokio::task::yield_now().await;
            }
        })
        .await;
        let [stuck, other] = [0x1001, 0x1002].map(|app| Tid::new(NINE, AppAddress::new(app)));
        // When
        let is_refused = |sent: &u64| node.stores.router.send(node.confirmed(stuck, *sent)).is_err();
        let taken = (0..THERE).find(is_refused);
        node.stores.router.send(node.confirmed(other, OTHERS)).expect("there is room for its answer");
        // Then
        assert_eq!(taken, Some(THERE / 8), "one has its share");
        let message = loop {
            let message = peer.hear().await;
            if message.header.destination == other {
                break message;
            }
        };
        peer.say(&ByHand::outcome(&message, Outcome::Delivered)).await;
        let outcome = loop {
            let (correlation, outcome) = next("an outcome", &mut node.settled).await;
            if correlation == OTHERS {
                break outcome;
            }
        };
        assert_eq!(outcome, Outcome::Delivered);
    });
}

// spec: GNCL-12
#[test]
fn all_outcomes_of_both_connections_wait_though_a_peer_that_gave_up_on_them_has_sent_as_many_again() {
    run(async {
        let mut node = Node::start(1).await;
        let first = lane_by_hand(&node, Lane::Control, 1).await;
        node.up().await;
        let peer = node.stores.gncl.peer(NINE).expect("it is linked");
        drop(first);
        node.broken().await;
        let settle = |correlation| {
            let ticket = Ticket {
                source: Tid::new(NINE, AppAddress::new(0x1001)),
                destination: node.tid(1),
                correlation,
            };
            peer.settle(ticket, Outcome::Delivered);
        };
        // Control's and Bulk's, of messages that their sender waits for no more, and of those that it has sent in their place.
        let all = 2 * 2 * answers_max(node.stores.config.gncl.queue_capacity) as u64;
        (0..all).for_each(settle);
        assert_eq!(node.stores.gncl.refusals.of("own frame not sent"), 0);
        // Of a peer that heeds nothing the rest is counted.
        settle(all);
        assert_eq!(node.stores.gncl.refusals.of("own frame not sent"), 1);
    });
}

#[test]
fn a_node_says_for_how_many_answers_it_has_room_which_are_not_fewer_where_its_queue_is_short() {
    for (capacity, answers) in [(1, 8_192), (1_024, 8_192), (2_048, 16_384), (65_536, 524_288)] {
        assert_eq!(answers_max(capacity), answers, "a queue of {capacity}");
    }
}
