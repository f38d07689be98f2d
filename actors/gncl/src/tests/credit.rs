//! Applications that read nothing: their senders are held, all others are not. No message is lost, duplicated or
//! reordered.

use std::{future::poll_fn, sync::Arc, task::Poll};

use futures_util::{FutureExt, StreamExt};
use sinew_runtime::{
    event_queue::EventStream,
    mailbox::Mailbox,
    outcome::{Outcome, Rejection},
    router::{LocalRoute, MessageSink as _},
    tid::Tid,
    time::Time,
    wire::{Class, Flags, Kind, Message},
};
use sinew_session::Ack;

use super::bench::{ByHand, NINE, Node, next, run, within};
use crate::{
    core::{Lane, read},
    peer_session::Arrived,
};

/// Maximum number of queued messages for a peer, in these tests: a window, too.
const QUEUE: usize = 64;
/// Messages that the slow application's mailbox holds.
pub(super) const MAILBOX: usize = 8;

/// Returns two nodes with small queues that have found each other, and a slow application of the second.
pub(super) async fn pair() -> (Node, Node, EventStream<Message>) {
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

/// Returns the messages at `node` that wait for a held destination.
fn held_at(node: &Node, peer: &Node) -> usize {
    let peer = node.state.store.peer(peer.address()).expect("it is linked");
    peer.session(Lane::Bulk).expect("it has a session for each class").outlet.in_backlog()
}

/// Sends to the slow application until its line at the sender is full. Returns the number of accepted messages.
pub(super) async fn fill(a: &Node, b: &Node) -> u64 {
    let mut taken = 0;
    within("the sender's line to be full", async {
        loop {
            match a.state.ctx.router.send(bulk(a, b.tid(1), taken)) {
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

/// Sends to the slow application, each message after the previous one was written, until one waits in its line at the
/// sender.
async fn hold(a: &Node, b: &Node) {
    let peer = a.state.store.peer(b.address()).expect("it is linked");
    let outlet = &peer.session(Lane::Bulk).expect("it has a session for each class").outlet;
    within("the slow one to be held", async {
        let mut number = 0;
        while outlet.in_backlog() == 0 {
            if outlet.waiting() == 0 {
                a.state.ctx.router.send(bulk(a, b.tid(1), number)).expect("nothing waits before it");
                number += 1;
            }
            tokio::task::yield_now().await;
        }
    })
    .await;
}

async fn take_all(slow: &mut EventStream<Message>, count: u64) {
    for number in 0..count {
        let message = next("a message for the slow one", slow).await;
        assert_eq!(message.payload[..], number.to_le_bytes());
    }
    assert!(slow.next_now().is_none(), "nothing comes twice");
}

trait NextNow<T> {
    fn next_now(&mut self) -> Option<T>;
}

impl<T> NextNow<T> for EventStream<T> {
    fn next_now(&mut self) -> Option<T> {
        self.next().now_or_never().flatten()
    }
}

#[test]
fn idle_application_holds_its_senders_and_no_others() {
    run(async {
        let (a, b, mut slow) = pair().await;
        let mut quick = b.app(2);
        let taken = fill(&a, &b).await;
        // Mailbox, line there (a window and one), line here, and the queue at the time when the destination became
        // held.
        let bound = MAILBOX + QUEUE + 1 + QUEUE / 4 + QUEUE;
        assert!(taken as usize <= bound, "{taken} were taken, and {bound} have room");
        for number in 0..200 {
            a.state.ctx.router.send(bulk(&a, b.tid(2), number)).expect("another destination is not held");
            let message = next("a message for the quick one", &mut quick).await;
            assert_eq!(message.payload[..], number.to_le_bytes());
        }
        take_all(&mut slow, taken).await;
        within("the sender to be held no more", async {
            while a.state.ctx.router.send(bulk(&a, b.tid(1), taken)).is_err() {
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

/// Messages that each pass a mailbox of two slots: if they waited for the next poll, it would take longer than the test
/// waits.
const MANY: u64 = 2_000;

#[test]
fn reader_of_a_full_mailbox_resumes_delivery_at_once() {
    run(async {
        let (a, b, _slow) = pair().await;
        let mailbox = Mailbox::new(2);
        let mut reader = mailbox.attach();
        b.state.ctx.router.set_local(b.tid(1).app, LocalRoute { sink: mailbox, events: Arc::new([]) });
        let mut sent = 0;
        within("all messages", async {
            for number in 0..MANY {
                while sent < MANY && a.state.ctx.router.send(bulk(&a, b.tid(1), sent)).is_ok() {
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
fn held_messages_survive_a_restart_of_gncl() {
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
fn message_held_at_its_sender_expires_there() {
    run(async {
        let (mut a, b, _slow) = pair().await;
        hold(&a, &b).await;
        let before = held_at(&a, &b);
        let mut message = a.confirmed(b.tid(1), 77);
        message.header.class = Class::Bulk;
        message.header.time_to_live_us = 500_000;
        message.header.sent = Time::now();
        a.state.ctx.router.send(message).expect("there is room for it");
        assert_eq!(held_at(&a, &b), before + 1, "it waits here");
        assert_eq!(next("its outcome", &mut a.settled).await, (77, Outcome::Expired));
    });
}

#[test]
fn message_held_at_its_receiver_expires_there() {
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
            peer.send(&message).await;
        }
        let outcome = peer.receive().await;
        assert_eq!((outcome.header.correlation, outcome.payload[0]), (3, Outcome::Expired.code()));
        for number in [1, 2] {
            let mut message = next("what was before it", &mut slow).await;
            assert_eq!(message.payload[..], [number]);
            message.settle(Outcome::Delivered);
        }
    });
}

#[test]
fn open_messages_of_a_slow_application_take_no_slots() {
    run(async {
        let (mut a, b, _slow) = pair().await;
        let mut quick = b.app(2);
        let peer = a.state.store.peer(b.address()).expect("it is linked");
        let outlet = &peer.session(Lane::Bulk).expect("it has a session for each class").outlet;
        within("its own bound to be reached", async {
            for correlation in 0.. {
                let mut message = a.confirmed(b.tid(1), correlation);
                message.header.class = Class::Bulk;
                // Until Bulk's connection is up, and the peer has reported room, that queue is the full one.
                let is_shared_queue_empty = outlet.waiting() == outlet.in_backlog();
                match a.state.ctx.router.send(message) {
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
        a.state.ctx.router.send(message).expect("the other destination has its own bound");
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
fn removed_destination_frees_its_held_senders() {
    run(async {
        let (mut a, b, _slow) = pair().await;
        fill(&a, &b).await;
        b.state.ctx.router.remove_local(b.tid(1).app);
        within("the lines to be empty", async {
            while held_at(&a, &b) > 0 {
                tokio::task::yield_now().await;
            }
        })
        .await;
        // Room comes and goes as held messages are rejected: each attempt is a message of its own.
        let mut taken = 1;
        let sent = |number| {
            let mut message = a.confirmed(b.tid(1), number);
            message.header.class = Class::Bulk;
            a.state.ctx.router.send(message)
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
fn peer_within_its_credit_is_never_refused() {
    run(async {
        const APPS: u32 = 12;
        let mut node = Node::start_with(1, |config| config.gncl.queue_capacity = QUEUE).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        let mut inboxes: Vec<_> = (1..=APPS).map(|number| node.app_of(number, MAILBOX)).collect();
        // Given: a peer that reads only after it has sent all that its credit allows to idle applications.
        let (mut sent, mut until, mut bursts) = (0, 1 + QUEUE as u64, Vec::new());
        for number in 1..=APPS {
            let line = u64::from(node.tid(number).app.bits());
            // To be held it must have more than its mailbox holds.
            let (mut burst, mut is_held) = (0, false);
            while !is_held || burst <= MAILBOX as u64 {
                assert!(burst <= 2 * QUEUE as u64, "it is not held, and was sent {burst}");
                while sent + 1 < until {
                    let mut message = node.message(node.tid(number), b"");
                    message.header.source.node = NINE;
                    peer.send(&message).await;
                    (sent, burst) = (sent + 1, burst + 1);
                }
                let word = peer.try_receive_any().await.expect("the link stands");
                assert_eq!(word.header.kind, Kind::GNCL_ACK);
                let ack: Ack = read(&word.payload).expect("an ACK has a payload");
                until = until.max(ack.next + ack.room.expect("it says how much may come").0);
                is_held = ack.held.contains(&line);
            }
            bursts.push(burst);
        }
        let peer = node.state.store.peer(NINE).expect("it is linked");
        let arrived = || peer.session(Lane::Control).expect("it has one").account().arrived;
        within("all to have come", async {
            while arrived().taken < sent {
                tokio::task::yield_now().await;
            }
        })
        .await;
        // Then: more than three windows wait, and nothing was rejected.
        assert!(arrived().waiting as usize > 3 * QUEUE && arrived().refused == 0, "{:?}", arrived());
        for (inbox, burst) in inboxes.iter_mut().zip(bursts) {
            for _ in 0..burst {
                next("a message for one of them", inbox).await;
            }
        }
    });
}

/// Sends two messages to each of this many applications with room for one, and waits until all have arrived.
async fn fill_many(node: &mut Node, apps: u32) -> Vec<EventStream<Message>> {
    let mut peer = ByHand::linked_to(node).await;
    let inboxes = (1..=apps).map(|number| node.app_of(number, 1)).collect();
    for number in 1..=apps {
        for _ in 0..2 {
            let mut message = node.message(node.tid(number), b"");
            message.header.source.node = NINE;
            peer.send(&message).await;
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
    let peer = node.state.store.peer(NINE).expect("it is linked");
    peer.session(Lane::Control).expect("it has one").account().arrived
}

// spec: CREDIT-4
#[test]
fn many_applications_are_held_and_an_excess_is_reported() {
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
        let refused = node.state.store.refusals.by_cause();
        assert!(refused.contains(&("too many full applications", 1)), "{refused:?}");
    });
}

#[test]
fn held_list_fits_a_node_with_short_messages() {
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
                a.state.ctx.router.send(a.message(b.tid(number), b"")).expect("there is room for it");
            }
        }
        let peer = a.state.store.peer(b.address()).expect("it is linked");
        within("the last of them to be held", async {
            while peer.session(Lane::Control).expect("it has one").outlet.in_backlog() == 0 {
                let _ = a.state.ctx.router.send(a.message(b.tid(APPS), b""));
                tokio::task::yield_now().await;
            }
        })
        .await;
        let refused = a.state.store.refusals.by_cause();
        assert!(refused.iter().all(|(cause, _)| *cause != "violation"), "{refused:?}");
    });
}

#[test]
fn sender_waits_for_room_at_a_slow_application() {
    run(async {
        // Given: everything on the way to the slow application is full, and a task that keeps one more message
        let (a, b, mut slow) = pair().await;
        let taken = fill(&a, &b).await;
        let peer = a.state.store.peer(b.address()).expect("it is linked");
        let mut kept = Some(bulk(&a, b.tid(1), taken));
        let waits = tokio::spawn(poll_fn(move |cx| {
            let Some(message) = kept.take() else { return Poll::Pending };
            match peer.offer(message, Some(cx.waker())) {
                Ok(()) => Poll::Ready(()),
                Err(refused) => {
                    assert_eq!(refused.why, Rejection::QueueFull);
                    kept = Some(refused.message);
                    Poll::Pending
                }
            }
        }));
        tokio::task::yield_now().await;
        assert!(!waits.is_finished());
        // When, then
        for number in 0..=taken {
            let message = next("a message for the slow one", &mut slow).await;
            assert_eq!(message.payload[..], number.to_le_bytes());
        }
        within("the task to end", waits).await.expect("it does not panic");
    });
}
