//! Several outcomes in one frame, between two nodes that support it. spec: GNCL-17

use bytes::Bytes;
use sinew_runtime::{
    outcome::{Outcome, ReceiptSink as _, Rejection, Ticket},
    tid::{AppAddress, NodeAddress, Tid},
    wire::{Kind, Message},
};
use sinew_session::outlet::read_outcomes;

use super::{
    bench::{ByHand, NINE, Node, introduction, next, pair, run, within},
    classes::lane_by_hand,
};
use crate::{
    core::{Introduction, Lane},
    frame::frame,
    peer_session::answers_max,
};

/// Returns one frame of peer 9 with outcomes for messages from application 1 of node 1 to its own application 1, its
/// bytes written by hand.
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
    frame(NINE, NodeAddress::new(1), Kind::GNCL_OUTCOMES, Bytes::from(payload))
}

/// Same as [`said`], with runs: the first correlation of each, its byte, and the number of its messages.
fn runs(runs: &[(u64, u8, u8)]) -> Message {
    let mut payload = Vec::new();
    for (correlation, code, count) in runs {
        payload.extend([0x01, 0x10, 0, 0, 0x01, 0x10, 0, 0]);
        payload.extend(correlation.to_le_bytes());
        payload.extend([*code, *count]);
    }
    frame(NINE, NodeAddress::new(1), Kind::GNCL_OUTCOME_RUNS, Bytes::from(payload))
}

/// Returns a node with a handwritten peer that has `count` confirmed messages of it, numbered from 1.
async fn owing(count: u64) -> (Node, ByHand) {
    let mut node = Node::start(1).await;
    let mut peer = ByHand::linked_to(&mut node).await;
    for correlation in 1..=count {
        let to = Tid::new(NINE, AppAddress::new(0x1001));
        node.state.ctx.router.send(node.confirmed(to, correlation)).unwrap();
        assert_eq!(peer.receive().await.header.correlation, correlation);
    }
    (node, peer)
}

#[test]
fn invalid_outcome_spoils_no_other_in_its_frame() {
    run(async {
        let (mut node, mut peer) = owing(4).await;
        peer.send(&said(&[(2, 0), (1, 2), (77, 0), (3, 200), (4, 20)])).await;
        let full = Outcome::Rejected(Rejection::QueueFull);
        for expected in [(2, Outcome::Delivered), (1, Outcome::Failed), (4, full)] {
            assert_eq!(next("an outcome", &mut node.settled).await, expected);
        }
        node.counted("no such outcome").await;
        let peer = node.state.store.peer(NINE).expect("it is linked");
        assert_eq!(peer.unconfirmed(), 1, "the third waits for its outcome");
    });
}

#[test]
fn run_settles_its_outstanding_messages_alone() {
    run(async {
        // The second run covers a message that has its outcome and many that were never sent; the third one has an
        // unknown byte.
        let (mut node, mut peer) = owing(6).await;
        peer.send(&runs(&[(2, 0, 2), (1, 2, 100), (5, 200, 1)])).await;
        peer.send(&said(&[(4, 0), (6, 20)])).await;
        let failed = [(1, Outcome::Failed), (4, Outcome::Failed), (5, Outcome::Failed), (6, Outcome::Failed)];
        let delivered = [(2, Outcome::Delivered), (3, Outcome::Delivered)];
        for expected in delivered.into_iter().chain(failed) {
            assert_eq!(next("an outcome", &mut node.settled).await, expected);
        }
        node.counted("no such outcome").await;
        let peer = node.state.store.peer(NINE).expect("it is linked");
        assert_eq!(peer.unconfirmed(), 0);
    });
}

#[test]
fn invalid_runs_end_the_connection() {
    let mut truncated = runs(&[(1, 0, 1)]);
    truncated.payload = truncated.payload.slice(..17);
    let invalid = [
        runs(&[]),
        truncated,
        runs(&[(1, 0, 0)]),
        runs(&[(1, 0, 129)]),
        runs(&[(1, 0, 255)]),
        runs(&[(1, 0, 64), (65, 0, 65)]),
        runs(&[(u64::MAX, 0, 2)]),
    ];
    for message in invalid {
        run(async move {
            let (_node, mut peer) = owing(1).await;
            peer.send(&message).await;
            let refusal = peer.refusal().await;
            assert_eq!(refusal.cause, "violation", "{:?}: {refusal:?}", message.payload);
        });
    }
}

#[test]
fn truncated_excessive_or_empty_outcomes_end_the_connection() {
    for length in [0, 16, 18, 17 * 129] {
        run(async move {
            let (_node, mut peer) = owing(1).await;
            peer.send(&from_nine(vec![0; length])).await;
            let refusal = peer.refusal().await;
            assert_eq!(refusal.cause, "violation", "{length} bytes: {refusal:?}");
        });
    }
}

#[test]
fn batched_outcomes_are_sent_only_if_supported() {
    run(async {
        // Given: a peer that accepts single outcomes, one that accepts several and one that accepts runs, each of
        // which has sent many confirmed messages.
        let runs = (Some(Kind::GNCL_OUTCOME_RUNS), vec!["outcomes", "outcome-runs"]);
        for (kind, features) in [(None, vec![]), (Some(Kind::GNCL_OUTCOMES), vec!["outcomes"]), runs] {
            let node = Node::start(1).await;
            let mut inbox = node.app(1);
            let features = features.into_iter().map(str::to_owned).collect();
            let mut peer =
                ByHand::greeting(&node, &Introduction { features, ..introduction(node.address()) }).await;
            for correlation in 1..=64 {
                let mut message = node.message(node.tid(1), b"");
                message.header.source.node = NINE;
                message.header.flags = sinew_runtime::wire::Flags::CONFIRM;
                message.header.correlation = correlation;
                peer.send(&message).await;
            }
            // When: they are read as fast as possible.
            let mut taken = Vec::new();
            for _ in 0..64 {
                taken.push(next("a message", &mut inbox).await);
            }
            for mut message in taken {
                message.settle(Outcome::Delivered);
            }
            // Then: each outcome arrives once, and those of several in one frame in the form that the peer supports.
            let (mut reported, mut frames) = (0, 0);
            while reported < 64 {
                let message = peer.receive().await;
                frames += 1;
                let outcomes = read_outcomes(message.header.kind, &message.payload);
                reported += match message.header.kind {
                    Kind::OUTCOME => 1,
                    several => {
                        assert_eq!(Some(several), kind);
                        outcomes.expect("whole outcomes").map(|run| usize::from(run.count)).sum()
                    }
                };
            }
            assert_eq!((reported, frames < 64), (64, kind.is_some()), "{frames} frames");
        }
    });
}

#[test]
fn flood_of_confirmed_messages_has_each_outcome_once() {
    run(async {
        let (mut a, b) = pair().await;
        let mut inbox = b.app(1);
        for correlation in 1..=1_000 {
            a.state.ctx.router.send(a.confirmed(b.tid(1), correlation)).unwrap();
        }
        for _ in 0..1_000 {
            next("a message", &mut inbox).await.settle(Outcome::Delivered);
        }
        let mut reported = Vec::new();
        for _ in 0..1_000 {
            let (correlation, outcome) = next("an outcome", &mut a.settled).await;
            assert_eq!(outcome, Outcome::Delivered);
            reported.push(correlation);
        }
        assert_eq!(reported, (1..=1_000).collect::<Vec<_>>(), "in the order in which they were said");
    });
}

/// Returns the outcomes of each of `count` confirmed messages, to two applications in turn, by correlation. All
/// received messages are handled while there is no connection.
async fn outcomes_with_queue_lengths(sender: usize, receiver: usize, count: u64) -> Vec<Vec<Outcome>> {
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
        if a.state.ctx.router.send(confirmed).is_ok() {
            taken.push(next("a message", &mut inboxes[to]).await);
        }
    }
    b.stop_layer();
    for mut message in taken {
        message.settle(Outcome::Delivered);
    }
    b.start_layer().await;
    b.find(a.address(), a.listens_at());
    let mut reported = vec![Vec::new(); count as usize];
    for _ in 0..count {
        let (correlation, outcome) = next("an outcome", &mut a.settled).await;
        reported[correlation as usize].push(outcome);
    }
    let dropped = b.state.store.refusals.of("own frame not sent");
    assert_eq!(dropped, 0, "outcomes of a queue of {sender} at one of {receiver}");
    let peer = a.state.store.peer(b.address()).expect("it is linked");
    assert_eq!(peer.unconfirmed(), 0);
    reported
}

// spec: GNCL-12
#[test]
fn each_confirmed_message_has_one_outcome_with_unequal_queues() {
    const COUNT: u64 = 1_500;
    run(async {
        for (sender, receiver) in [(1_024, 1), (1, 1_024), (1, 1), (65_536, 1), (1_024, 1_024)] {
            let reported = outcomes_with_queue_lengths(sender, receiver, COUNT).await;
            let full = Outcome::Rejected(Rejection::QueueFull);
            let is_one = |reported: &Vec<Outcome>| *reported == [Outcome::Delivered] || *reported == [full];
            assert!(reported.iter().all(is_one), "{sender} to {receiver}: {reported:?}");
            let delivered =
                reported.iter().filter(|reported| **reported == [Outcome::Delivered]).count() as u64;
            // A queue of one has one of each destination open.
            assert_eq!(delivered, if sender == 1 { 2 } else { COUNT }, "{sender} to {receiver}");
        }
    });
}

// spec: GNCL-12
#[test]
fn open_messages_are_bounded_by_the_peers_answer_room() {
    run(async {
        let node = Node::start(1).await;
        let hello = Introduction { answers_max: 3, ..introduction(node.address()) };
        let mut peer = ByHand::greeting(&node, &hello).await;
        let send = |correlation: u64| {
            // To several applications: for each alone there would be room for more.
            let to = Tid::new(NINE, AppAddress::new(0x1000 + correlation as u32));
            node.state.ctx.router.send(node.confirmed(to, correlation))
        };
        within("the peer to be known", async {
            while node.state.store.peer(NINE).is_none() {
                tokio::task::yield_now().await;
            }
        })
        .await;
        for correlation in 1..=3 {
            send(correlation).expect("there is room for its answer");
        }
        assert!(send(4).is_err(), "there is none");
        let first = peer.receive().await;
        peer.send(&ByHand::outcome(&first, Outcome::Delivered)).await;
        within("the outcome", async {
            while node.state.store.peer(NINE).is_some_and(|peer| peer.unconfirmed() == 3) {
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
fn silent_application_takes_no_answer_room_of_another() {
    run(async {
        // Given: a queue longer than all the room of the peer. Nodes with a queue of at most the usual length announce
        // that room.
        const THERE: u64 = 8_192;
        const OTHERS: u64 = 1_000_000;
        let mut node = Node::start_with(1, |config| config.gncl.queue_capacity = 65_536).await;
        let hello = Introduction { answers_max: THERE, ..introduction(node.address()) };
        let mut peer = ByHand::greeting(&node, &hello).await;
        within("the peer to be known", async {
            while node.state.store.peer(NINE).is_none() {
                tokio::task::yield_now().await;
            }
        })
        .await;
        let [stuck, other] = [0x1001, 0x1002].map(|app| Tid::new(NINE, AppAddress::new(app)));
        // When
        let is_refused = |sent: &u64| node.state.ctx.router.send(node.confirmed(stuck, *sent)).is_err();
        let taken = (0..THERE).find(is_refused);
        node.state.ctx.router.send(node.confirmed(other, OTHERS)).expect("there is room for its answer");
        // Then
        assert_eq!(taken, Some(THERE / 8), "one has its share");
        let message = loop {
            let message = peer.receive().await;
            if message.header.destination == other {
                break message;
            }
        };
        peer.send(&ByHand::outcome(&message, Outcome::Delivered)).await;
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
fn all_outcomes_of_both_connections_wait_despite_resends() {
    run(async {
        let mut node = Node::start(1).await;
        let first = lane_by_hand(&node, Lane::Control, 1).await;
        node.up().await;
        let peer = node.state.store.peer(NINE).expect("it is linked");
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
        // Control's and Bulk's, of messages with an abandoned wait, and of those that were sent in their place.
        let all = 2 * 2 * answers_max(node.state.ctx.config.gncl.queue_capacity) as u64;
        (0..all).for_each(settle);
        assert_eq!(node.state.store.refusals.of("own frame not sent"), 0);
        // For a peer that ignores the limit the rest is counted.
        settle(all);
        assert_eq!(node.state.store.refusals.of("own frame not sent"), 1);
    });
}

#[test]
fn short_queue_does_not_shrink_the_answer_room() {
    for (capacity, answers) in [(1, 8_192), (1_024, 8_192), (2_048, 16_384), (65_536, 524_288)] {
        assert_eq!(answers_max(capacity), answers, "a queue of {capacity}");
    }
}
