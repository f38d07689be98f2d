//! Messages for applications from ended incarnations of a peer: each is delivered or rejected, and no incarnation is
//! kept forever.

use std::sync::Arc;

use futures_util::FutureExt as _;
use sinew_runtime::{
    event_queue::EventStream,
    outcome::{Receipt, Rejection},
    router::SubmitError,
    tid::{AppAddress, Incarnation},
    time::Time,
    wire::Message,
};
use sinew_session::{
    Ack,
    counts::Account,
    outlet::{LinkNumber, backlog_key},
    place::Place,
};

use super::bench::{NINE, Node, next, run, within};
use crate::{
    core::Lane,
    outstanding::OutstandingDestinations,
    peer::Peer,
    peer_session::{Admission, PeerSession},
    receive_counters::Disposition,
};

/// Maximum number of ended incarnations with remaining messages.
const GONE_MAX: u64 = 16;

/// Returns an incarnation of node 9, on placeholder connections.
fn create_incarnation(node: &Node, number: u64) -> Arc<Peer> {
    let peer = node.state.store.create_in_test(NINE, Incarnation(number), &node.state);
    let session = session(&peer);
    session.attach(LinkNumber::default());
    let ack = Ack {
        receiver_id: number,
        epoch: number,
        peer_epoch: 0,
        next: 1,
        change: 0,
        held: Vec::new(),
        room: None,
    };
    session.on_ack(LinkNumber::default(), &ack, Time::now());
    peer
}

fn session(peer: &Peer) -> &PeerSession {
    peer.session(Lane::Control).expect("all classes have one")
}

/// Receives a confirmed message of this incarnation for the first application. It is in hand.
fn receive_message(node: &Node, peer: &Arc<Peer>) -> Message {
    let mut message = node.message(node.tid(1), b"said");
    message.header.source.node = NINE;
    (message.header.number, message.header.correlation) = (1, 1);
    let taken = session(peer).on_message(LinkNumber::default(), &message, None);
    assert_eq!(taken.expect("it is the next one"), Admission::Deliver);
    message.receipt = Some(Receipt::new(peer.clone(), message.ticket()));
    message
}

/// Queues the message for its full application.
fn waits(node: &Node, peer: &Arc<Peer>, message: Message) -> Result<(), Message> {
    let line = backlog_key(&message.header).expect("it is for a mailbox");
    session(peer).enqueue(line, message)?;
    node.state.store.queues_changed.notify_one();
    Ok(())
}

/// Returns a node with a full first application.
async fn full() -> (Node, EventStream<Message>) {
    let node = Node::start(1).await;
    let inbox = node.app_of(1, 1);
    node.send(node.tid(1), b"in the way");
    (node, inbox)
}

/// Creates and ends these incarnations, one after the other, each with a queued message.
fn create_and_end(node: &Node, numbers: impl Iterator<Item = u64>) {
    for number in numbers {
        let peer = create_incarnation(node, number);
        let message = receive_message(node, &peer);
        waits(node, &peer, message).expect("there is room");
        node.state.store.forget(NINE);
    }
}

/// Returns the account of all messages of those incarnations, after none of them is left. This many were taken. An
/// incarnation is no longer listed when it is dropped, and its messages are counted within that drop.
async fn account_after_all(node: &Node, taken: u64) -> Account {
    let gncl = &node.state.store;
    let account = within("the ended incarnations to be dropped", async {
        loop {
            let account = node.state.account(&Place::FromFormerNodes);
            let is_none_left =
                gncl.all_incarnations().is_empty() && gncl.outstanding(NINE) == OutstandingDestinations::NONE;
            if is_none_left && account.taken == taken {
                return account;
            }
            tokio::task::yield_now().await;
        }
    })
    .await;
    assert_eq!(account.unexplained(), 0, "{account:?}");
    account
}

#[test]
fn ended_incarnations_with_held_messages_are_bounded() {
    run(async {
        let (node, mut inbox) = full().await;
        create_and_end(&node, 1..=GONE_MAX + 1);
        assert!(node.state.store.outstanding(NINE).contains(AppAddress::new(0x1001)));
        for _ in 0..=GONE_MAX {
            next("what was in the way, and a message of each incarnation", &mut inbox).await;
        }
        let account = account_after_all(&node, GONE_MAX + 1).await;
        // The first one may have been on offer at that moment.
        let given_up = account.failed + account.rejected;
        assert_eq!((account.handed_on, given_up), (GONE_MAX, 1), "{account:?}");
    });
}

#[test]
fn evicted_incarnations_message_in_hand_is_rejected() {
    run(async {
        let (node, mut inbox) = full().await;
        let first = create_incarnation(&node, 1);
        let message = receive_message(&node, &first);
        node.state.store.forget(NINE);
        create_and_end(&node, 2..=GONE_MAX + 1);
        let message = waits(&node, &first, message).expect_err("nothing waits there any more");
        node.state.ctx.router.refuse(SubmitError::new(message, Rejection::QueueFull));
        session(&first).processing_guard().finish(Disposition::Refused);
        drop(first);
        for _ in 0..=GONE_MAX {
            next("what was in the way, and a message of each other incarnation", &mut inbox).await;
        }
        let account = account_after_all(&node, GONE_MAX + 1).await;
        assert_eq!((account.handed_on, account.rejected), (GONE_MAX, 1));
    });
}

#[test]
fn message_in_hand_of_a_forgotten_incarnation_is_delivered() {
    run(async {
        let (node, mut inbox) = full().await;
        let peer = create_incarnation(&node, 1);
        let message = receive_message(&node, &peer);
        node.state.store.forget(NINE);
        waits(&node, &peer, message).expect("there is room");
        drop(peer);
        assert_eq!(next("what was in the way", &mut inbox).await.payload[..], *b"in the way");
        assert_eq!(next("the message", &mut inbox).await.payload[..], *b"said");
        let account = account_after_all(&node, 1).await;
        assert_eq!(account.handed_on, 1);
    });
}

#[test]
fn keeper_is_notified_when_an_ended_incarnation_is_idle() {
    run(async {
        // Given: the test is the only receiver of notifications.
        let (mut node, _inbox) = full().await;
        node.stop_layer();
        let state = node.state.clone();
        let is_told = || state.store.queues_changed.notified().now_or_never().is_some();
        is_told();
        let peer = create_incarnation(&node, 1);
        drop(receive_message(&node, &peer));
        // When
        state.store.forget(NINE);
        assert!(is_told() && !is_told());
        assert_eq!(state.store.outstanding(NINE), OutstandingDestinations::All);
        session(&peer).processing_guard().finish(Disposition::Refused);
        // Then
        assert!(is_told());
        drop(peer);
        node.start_layer().await;
        let account = account_after_all(&node, 1).await;
        assert_eq!(account.rejected, 1);
    });
}

#[test]
fn disposition_is_recorded_with_the_next_message() {
    run(async {
        // Given: a first message, of which the disposition is not recorded yet
        let (mut node, _inbox) = full().await;
        node.stop_layer();
        let is_told = || node.state.store.queues_changed.notified().now_or_never().is_some();
        let peer = create_incarnation(&node, 1);
        let mut message = receive_message(&node, &peer);
        drop(message.receipt.take());
        let session = session(&peer);
        let counts = || {
            let arrived = session.account().arrived;
            (arrived.taken, arrived.forwarded, arrived.waiting)
        };
        assert_eq!(counts(), (1, 0, 1));
        // When, then
        message.header.number = 2;
        let taken = session.on_message(LinkNumber::default(), &message, Some(Disposition::Forwarded));
        assert_eq!((taken.expect("it is the next one"), counts()), (Admission::Deliver, (2, 1, 1)));
        // And: also if the peer has ended meanwhile, and with a notification.
        session.fence();
        is_told();
        message.header.number = 3;
        let taken = session.on_message(LinkNumber::default(), &message, Some(Disposition::Forwarded));
        assert_eq!((taken.expect("nothing is checked"), counts()), (Admission::Drop, (2, 2, 0)));
        assert!(is_told());
    });
}
