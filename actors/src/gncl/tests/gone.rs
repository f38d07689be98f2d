//! What lives of a peer that are gone have left for applications: it comes, or is given up, and no life is kept for it for ever.

use std::sync::Arc;

use futures_util::FutureExt as _;
use sinew_runtime::{
    outcome::{Receipt, Rejection},
    post::PostStream,
    router::Refused,
    tid::{AppAddress, Incarnation},
    time::Time,
    wire::Message,
};

use super::bench::{NINE, Node, next, run, within};
use crate::{
    audit::{self, Account, Place},
    gncl::{
        arrivals::End,
        core::Lane,
        owed::Owed,
        peer::Peer,
        way::{Taken, Way},
    },
    outlet::{LinkNumber, line_of},
    session::Ack,
};

/// Lives that may be gone and have left messages.
const GONE_MAX: u64 = 16;

/// A life of node 9, on connections that stand for themselves.
fn life(node: &Node, number: u64) -> Arc<Peer> {
    let peer = node.stores.gncl.meet_in_test(NINE, Incarnation(number), &node.stores);
    let way = way(&peer);
    way.attach(LinkNumber::default());
    let ack = Ack { memory: number, epoch: number, of: 0, next: 1, change: 0, held: Vec::new(), room: None };
    way.heard(LinkNumber::default(), &ack, Time::now());
    peer
}

fn way(peer: &Peer) -> &Way {
    peer.way(Lane::Control).expect("all classes have one")
}

/// A confirmed message of this life has come for the first application, and is in hand.
fn comes(node: &Node, peer: &Arc<Peer>) -> Message {
    let mut message = node.message(node.tid(1), b"said");
    message.header.source.node = NINE;
    (message.header.number, message.header.correlation) = (1, 1);
    let taken = way(peer).arrive(LinkNumber::default(), &message);
    assert_eq!(taken.expect("it is the next one"), Taken::Yes);
    message.receipt = Some(Receipt::new(peer.clone(), message.ticket()));
    message
}

/// What came finds its application full.
fn waits(node: &Node, peer: &Arc<Peer>, message: Message) -> Result<(), Message> {
    let line = line_of(&message.header).expect("it is for a mailbox");
    way(peer).put_in_line(line, message)?;
    node.stores.gncl.held_up.notify_one();
    Ok(())
}

/// A node whose first application takes nothing more.
async fn full() -> (Node, PostStream<Message>) {
    let node = Node::start(1).await;
    let inbox = node.app_of(1, 1);
    node.send(node.tid(1), b"in the way");
    (node, inbox)
}

/// So many lives, one after the other, of each of which a message waits when it is gone.
fn come_and_go(node: &Node, lives: impl Iterator<Item = u64>) {
    for number in lives {
        let peer = life(node, number);
        let message = comes(node, &peer);
        waits(node, &peer, message).expect("there is room");
        node.stores.gncl.forget(NINE);
    }
}

/// What became of all that those lives said, once no life of the peer is left.
async fn once_nobody_is_left(node: &Node) -> Account {
    let gncl = &node.stores.gncl;
    within("the lives that are gone to be dropped", async {
        while !gncl.met().is_empty() || gncl.owed(NINE) != Owed::NOBODY {
            tokio::task::yield_now().await;
        }
    })
    .await;
    let account = audit::read(&node.stores).account(&Place::FromFormerNodes);
    assert_eq!(account.unexplained(), 0, "{account:?}");
    account
}

#[test]
fn lives_that_come_and_go_while_an_application_takes_nothing_are_not_kept_for_ever() {
    run(async {
        let (node, mut inbox) = full().await;
        come_and_go(&node, 1..=GONE_MAX + 1);
        assert!(node.stores.gncl.owed(NINE).has(AppAddress::new(0x1001)));
        for _ in 0..=GONE_MAX {
            next("what was in the way, and a message of each life", &mut inbox).await;
        }
        let account = once_nobody_is_left(&node).await;
        // The first one may have been on offer just then.
        let given_up = account.failed + account.rejected;
        assert_eq!((account.taken, account.handed_on, given_up), (GONE_MAX + 1, GONE_MAX, 1), "{account:?}");
    });
}

#[test]
fn what_is_in_hand_when_its_life_is_given_up_waits_nowhere() {
    run(async {
        let (node, mut inbox) = full().await;
        let first = life(&node, 1);
        let message = comes(&node, &first);
        node.stores.gncl.forget(NINE);
        come_and_go(&node, 2..=GONE_MAX + 1);
        let message = waits(&node, &first, message).expect_err("nothing waits there any more");
        node.stores.router.refuse(Refused::new(message, Rejection::QueueFull));
        way(&first).hand().ends(End::Refused);
        drop(first);
        for _ in 0..=GONE_MAX {
            next("what was in the way, and a message of each other life", &mut inbox).await;
        }
        let account = once_nobody_is_left(&node).await;
        assert_eq!((account.taken, account.handed_on, account.rejected), (GONE_MAX + 1, GONE_MAX, 1));
    });
}

#[test]
fn what_was_in_hand_when_its_life_was_forgotten_comes_also_where_it_has_to_wait() {
    run(async {
        let (node, mut inbox) = full().await;
        let peer = life(&node, 1);
        let message = comes(&node, &peer);
        node.stores.gncl.forget(NINE);
        waits(&node, &peer, message).expect("there is room");
        drop(peer);
        assert_eq!(next("what was in the way", &mut inbox).await.payload[..], *b"in the way");
        assert_eq!(next("the message", &mut inbox).await.payload[..], *b"said");
        let account = once_nobody_is_left(&node).await;
        assert_eq!((account.taken, account.handed_on), (1, 1));
    });
}

#[test]
fn whoever_keeps_a_life_that_is_gone_is_told_when_nothing_of_it_is_in_hand_any_more() {
    run(async {
        // Given: nobody but the test hears what is told.
        let (mut node, _inbox) = full().await;
        node.stop_layer();
        let stores = node.stores.clone();
        let is_told = || stores.gncl.held_up.notified().now_or_never().is_some();
        is_told();
        let peer = life(&node, 1);
        drop(comes(&node, &peer));
        // When
        stores.gncl.forget(NINE);
        assert!(is_told() && !is_told());
        assert_eq!(stores.gncl.owed(NINE), Owed::Anyone);
        way(&peer).hand().ends(End::Refused);
        // Then
        assert!(is_told());
        drop(peer);
        node.start_layer().await;
        let account = once_nobody_is_left(&node).await;
        assert_eq!((account.taken, account.rejected), (1, 1));
    });
}
