//! Applications that take nothing: their senders are held, nobody else is, and nothing is lost, double or out of order.

use std::{future::poll_fn, sync::Arc};

use futures_util::{FutureExt, StreamExt};
use sinew_runtime::{
    mailbox::Mailbox,
    outcome::{Outcome, Rejection},
    post::PostStream,
    router::LocalRoute,
    tid::Tid,
    time::Time,
    wire::{Class, Flags, Kind, Message},
};

use super::bench::{ByHand, NINE, Node, next, run, within};
use crate::{
    gncl::{
        Arrived,
        core::{Lane, read},
    },
    session::Ack,
};

/// Messages that wait for a peer at most, in these tests: a window, too.
const QUEUE: usize = 64;
/// Messages that the slow application's mailbox holds.
pub(super) const MAILBOX: usize = 8;

/// Two nodes with small queues that have found each other, and an application of the second that is slow.
pub(super) async fn pair() -> (Node, Node, PostStream<Message>) {
    let small = |number| Node::start_with(number, |config| config.gncl.queue_capacity = QUEUE);
    let (mut a, mut b) = (small(1).await, small(2).await);
    a.find(b.address(), b.listens_at());
    b.find(a.address(), a.listens_at());
    a.up().await;
    b.up().await;
    let slow = b.app_of(1, MAILBOX);
    (a, b, slow)
}

fn bulk(node: &Node, to: Tid, number: u64) -> Message {
    let mut message = node.message(to, &number.to_le_bytes());
    message.header.class = Class::Bulk;
    message
}

/// Messages that wait at `node` because their destination is held.
fn held_at(node: &Node, peer: &Node) -> usize {
    let peer = node.stores.gncl.peer(peer.address()).expect("it is linked");
    peer.way(Lane::Bulk).expect("it has a way for each class").outlet.in_lines()
}

/// Sends to the slow application until its line at the sender is full; returns how many were taken.
pub(super) async fn fill(a: &Node, b: &Node) -> u64 {
    let mut taken = 0;
    within("the sender's line to be full", async {
        loop {
            match a.stores.router.send(bulk(a, b.tid(1), taken)) {
                Ok(()) => taken += 1,
                Err(why) => assert_eq!(why, Rejection::QueueFull),
            }
            if held_at(a, b) >= QUEUE / 4 {
                break;
            }
            tokio::task::yield_now().await;
        }
    })
    .await;
    taken
}

/// Sends to the slow application, each message when the one before is out, until one waits in its line at the sender.
async fn hold(a: &Node, b: &Node) {
    let peer = a.stores.gncl.peer(b.address()).expect("it is linked");
    let outlet = &peer.way(Lane::Bulk).expect("it has a way for each class").outlet;
    within("the slow one to be held", async {
        let mut number = 0;
        while outlet.in_lines() == 0 {
            if outlet.waiting() == 0 {
                a.stores.router.send(bulk(a, b.tid(1), number)).expect("nothing waits before it");
                number += 1;
            }
            tokio::task::yield_now().await;
        }
    })
    .await;
}

async fn take_all(slow: &mut PostStream<Message>, count: u64) {
    for number in 0..count {
        let message = next("a message for the slow one", slow).await;
        assert_eq!(message.payload[..], number.to_le_bytes());
    }
    assert!(slow.next_now().is_none(), "nothing comes twice");
}

trait NextNow<T> {
    fn next_now(&mut self) -> Option<T>;
}

impl<T> NextNow<T> for PostStream<T> {
    fn next_now(&mut self) -> Option<T> {
        self.next().now_or_never().flatten()
    }
}

#[test]
fn an_application_that_takes_nothing_holds_its_senders_and_nobody_else() {
    run(async {
        let (a, b, mut slow) = pair().await;
        let mut quick = b.app(2);
        let taken = fill(&a, &b).await;
        // Mailbox, line there (a window and one), line here, and what was in the queue when it became held.
        let bound = MAILBOX + QUEUE + 1 + QUEUE / 4 + QUEUE;
        assert!(taken as usize <= bound, "{taken} were taken, and {bound} have room");
        for number in 0..200 {
            a.stores.router.send(bulk(&a, b.tid(2), number)).expect("another destination is not held");
            let message = next("a message for the quick one", &mut quick).await;
            assert_eq!(message.payload[..], number.to_le_bytes());
        }
        take_all(&mut slow, taken).await;
        within("the sender to be held no more", async {
            while a.stores.router.send(bulk(&a, b.tid(1), taken)).is_err() {
                tokio::task::yield_now().await;
            }
        })
        .await;
        assert_eq!(
            next("a message for one that takes again", &mut slow).await.payload[..],
            taken.to_le_bytes()
        );
    });
}

/// Messages that each go through a mailbox of two places: if they waited for the next look, it would be longer than the test waits.
const MANY: u64 = 2_000;

#[test]
fn what_waits_for_a_mailbox_goes_on_as_soon_as_its_reader_has_taken_something() {
    run(async {
        let (a, b, _slow) = pair().await;
        let mailbox = Mailbox::new(2);
        let mut reader = mailbox.attach();
        b.stores.router.set_local(b.tid(1).app, LocalRoute { outlet: mailbox, events: Arc::new([]) });
        let mut sent = 0;
        within("all messages", async {
            for number in 0..MANY {
                while sent < MANY && a.stores.router.send(bulk(&a, b.tid(1), sent)).is_ok() {
                    sent += 1;
                }
                let message = poll_fn(|cx| reader.poll_take(cx)).await.expect("nobody else reads it");
                assert_eq!(message.payload[..], number.to_le_bytes());
                reader.finish(Outcome::Delivered);
            }
        })
        .await;
    });
}

#[test]
fn what_waits_for_a_slow_application_outlives_its_nodes_gncl_and_its_senders() {
    run(async {
        let (mut a, mut b, mut slow) = pair().await;
        let taken = fill(&a, &b).await;
        b.stop_layer();
        b.start_layer().await;
        b.find(a.address(), a.listens_at());
        a.stop_layer();
        a.start_layer().await;
        a.find(b.address(), b.listens_at());
        take_all(&mut slow, taken).await;
    });
}

#[test]
fn what_waits_at_its_sender_expires_there() {
    run(async {
        let (mut a, b, _slow) = pair().await;
        hold(&a, &b).await;
        let before = held_at(&a, &b);
        let mut message = a.confirmed(b.tid(1), 77);
        message.header.class = Class::Bulk;
        message.header.time_to_live_us = 500_000;
        message.header.sent = Time::now();
        a.stores.router.send(message).expect("there is room for it");
        assert_eq!(held_at(&a, &b), before + 1, "it waits here");
        assert_eq!(next("its outcome", &mut a.settled).await, (77, Outcome::Expired));
    });
}

#[test]
fn what_waits_at_its_receiver_behind_what_may_wait_longer_expires_there() {
    run(async {
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        // Its mailbox has room for the first one.
        let mut slow = node.app_of(1, 1);
        for (number, time_to_live_us) in [(1, 0), (2, 0), (3, 200_000)] {
            let mut message = node.message(node.tid(1), &[number]);
            message.header.source.node = NINE;
            message.header.flags = Flags::CONFIRM;
            message.header.correlation = number.into();
            message.header.time_to_live_us = time_to_live_us;
            peer.say(&message).await;
        }
        let outcome = peer.hear().await;
        assert_eq!((outcome.header.correlation, outcome.payload[0]), (3, Outcome::Expired.code()));
        for number in [1, 2] {
            let mut message = next("what was before it", &mut slow).await;
            assert_eq!(message.payload[..], [number]);
            message.settle(Outcome::Delivered);
        }
    });
}

#[test]
fn confirmed_messages_that_a_slow_application_leaves_open_take_no_place_of_others() {
    run(async {
        let (mut a, b, _slow) = pair().await;
        let mut quick = b.app(2);
        let peer = a.stores.gncl.peer(b.address()).expect("it is linked");
        let outlet = &peer.way(Lane::Bulk).expect("it has a way for each class").outlet;
        within("its own bound to be reached", async {
            for correlation in 0.. {
                let mut message = a.confirmed(b.tid(1), correlation);
                message.header.class = Class::Bulk;
                // Until Bulk's connection is up, and when the peer has not said that it has room, that queue is what is full.
                let is_shared_queue_empty = outlet.waiting() == outlet.in_lines();
                match a.stores.router.send(message) {
                    Err(Rejection::QueueFull) if is_shared_queue_empty => break,
                    Ok(()) | Err(Rejection::QueueFull) => {}
                    Err(why) => panic!("{why}"),
                }
                while let Some((_, outcome)) = a.settled.next_now() {
                    assert_eq!(
                        outcome,
                        Outcome::Rejected(Rejection::QueueFull),
                        "what found no room said so"
                    );
                }
                tokio::task::yield_now().await;
            }
        })
        .await;
        let mut message = a.confirmed(b.tid(2), u64::MAX);
        message.header.class = Class::Bulk;
        a.stores.router.send(message).expect("the other destination has its own bound");
        next("the message", &mut quick).await.receipt.expect("it is confirmed").settle(Outcome::Delivered);
        loop {
            let (correlation, outcome) = next("the outcome", &mut a.settled).await;
            if correlation == u64::MAX {
                break assert_eq!(outcome, Outcome::Delivered);
            }
            assert_eq!(outcome, Outcome::Rejected(Rejection::QueueFull), "what found no room said so");
        }
    });
}

#[test]
fn what_waits_for_an_application_that_goes_is_refused_and_its_sender_is_held_no_more() {
    run(async {
        let (mut a, b, _slow) = pair().await;
        fill(&a, &b).await;
        b.stores.router.remove_local(b.tid(1).app);
        within("the lines to be empty", async {
            while held_at(&a, &b) > 0 {
                tokio::task::yield_now().await;
            }
        })
        .await;
        // Room comes and goes as what was held is refused: each try is a message of its own.
        let mut taken = 1;
        let sent = |number| {
            let mut message = a.confirmed(b.tid(1), number);
            message.header.class = Class::Bulk;
            a.stores.router.send(message)
        };
        within("room", async {
            while sent(taken).is_err() {
                taken += 1;
                tokio::task::yield_now().await;
            }
        })
        .await;
        let (mut number, mut outcome) = next("an outcome", &mut a.settled).await;
        while number != taken {
            (number, outcome) = next("its outcome", &mut a.settled).await;
        }
        assert_eq!(outcome, Outcome::Rejected(Rejection::NoSuchApplication));
    });
}

// spec: CREDIT-5
#[test]
fn a_peer_that_sends_what_it_may_to_many_who_take_nothing_is_refused_nothing() {
    run(async {
        const APPS: u32 = 12;
        let mut node = Node::start_with(1, |config| config.gncl.queue_capacity = QUEUE).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        let mut inboxes: Vec<_> = (1..=APPS).map(|number| node.app_of(number, MAILBOX)).collect();
        // Given a peer that hears only when it has sent all that it may who takes nothing.
        let (mut sent, mut until, mut bursts) = (0, 1 + QUEUE as u64, Vec::new());
        for number in 1..=APPS {
            let line = u64::from(node.tid(number).app.bits());
            // To be held it must have more than its mailbox takes.
            let (mut burst, mut is_held) = (0, false);
            while !is_held || burst <= MAILBOX as u64 {
                assert!(burst <= 2 * QUEUE as u64, "it is not held, and was sent {burst}");
                while sent + 1 < until {
                    let mut message = node.message(node.tid(number), b"");
                    message.header.source.node = NINE;
                    peer.say(&message).await;
                    (sent, burst) = (sent + 1, burst + 1);
                }
                let word = peer.try_hear_any().await.expect("the link stands");
                assert_eq!(word.header.kind, Kind::GNCL_ACK);
                let ack: Ack = read(&word.payload).expect("an ACK has a payload");
                until = until.max(ack.next + ack.room.expect("it says how much may come").0);
                is_held = ack.held.contains(&line);
            }
            bursts.push(burst);
        }
        let way = node.stores.gncl.peer(NINE).expect("it is linked");
        let arrived = || way.way(Lane::Control).expect("it has one").account().arrived;
        within("all to have come", async {
            while arrived().taken < sent {
                tokio::task::yield_now().await;
            }
        })
        .await;
        // Then more than three windows wait, and nothing was refused.
        assert!(arrived().waiting as usize > 3 * QUEUE && arrived().refused == 0, "{:?}", arrived());
        for (inbox, burst) in inboxes.iter_mut().zip(bursts) {
            for _ in 0..burst {
                next("a message for one of them", inbox).await;
            }
        }
    });
}

/// Has so many applications of which each takes one message be sent two, and waits until all have come.
async fn fill_many(node: &mut Node, apps: u32) -> Vec<PostStream<Message>> {
    let mut peer = ByHand::linked_to(node).await;
    let inboxes = (1..=apps).map(|number| node.app_of(number, 1)).collect();
    for number in 1..=apps {
        for _ in 0..2 {
            let mut message = node.message(node.tid(number), b"");
            message.header.source.node = NINE;
            peer.say(&message).await;
        }
    }
    within("all to have come", async {
        while arrived(node).taken < u64::from(2 * apps) {
            tokio::task::yield_now().await;
        }
    })
    .await;
    inboxes
}

fn arrived(node: &Node) -> Arrived {
    let peer = node.stores.gncl.peer(NINE).expect("it is linked");
    peer.way(Lane::Control).expect("it has one").account().arrived
}

// spec: CREDIT-4
#[test]
fn many_applications_may_take_nothing_at_once_and_of_one_too_many_it_is_said() {
    run(async {
        const MOST: u32 = 256;
        let mut node = Node::start(1).await;
        let _inboxes = fill_many(&mut node, MOST + 1).await;
        // The last one may still be in hand.
        within("one too many to be refused", async {
            while arrived(&node).refused == 0 {
                tokio::task::yield_now().await;
            }
        })
        .await;
        assert_eq!((arrived(&node).waiting, arrived(&node).refused), (u64::from(MOST), 1));
        let refused = node.stores.gncl.refusals.by_cause();
        assert!(refused.contains(&("too many full applications", 1)), "{refused:?}");
    });
}

#[test]
fn who_is_held_can_be_said_to_a_node_that_takes_only_short_messages() {
    run(async {
        const APPS: u32 = 60;
        let short = |number| Node::start_with(number, |config| config.payload_max = 64);
        let (mut a, mut b) = (short(1).await, short(2).await);
        a.find(b.address(), b.listens_at());
        b.find(a.address(), a.listens_at());
        a.up().await;
        b.up().await;
        let _inboxes: Vec<_> = (1..=APPS).map(|number| b.app_of(number, 1)).collect();
        for number in 1..=APPS {
            for _ in 0..2 {
                a.stores.router.send(a.message(b.tid(number), b"")).expect("there is room for it");
            }
        }
        let way = a.stores.gncl.peer(b.address()).expect("it is linked");
        within("the last of them to be held", async {
            while way.way(Lane::Control).expect("it has one").outlet.in_lines() == 0 {
                let _ = a.stores.router.send(a.message(b.tid(APPS), b""));
                tokio::task::yield_now().await;
            }
        })
        .await;
        let refused = a.stores.gncl.refusals.by_cause();
        assert!(refused.iter().all(|(cause, _)| *cause != "violation"), "{refused:?}");
    });
}
