//! Reports of a peer's end follow its last message.

use bytes::Bytes;
use futures_util::{FutureExt as _, StreamExt as _};
use sinew_runtime::{
    mailbox::About,
    outcome::Rejection,
    tid::{AppAddress, Incarnation, NodeAddress, Tid},
    time::Time,
    wire::{Header, Kind, Message},
};

use super::{
    bench::{ByHand, KIND, NINE, Node, introduction, next, run, within},
    credit,
};
use crate::{core::Introduction, node_down_events, outstanding::OutstandingDestinations};

/// Returns the incarnation of a linked peer.
pub(super) fn incarnation_of(node: &Node, peer: NodeAddress) -> Incarnation {
    node.state.store.peer(peer).expect("it is linked").incarnation
}

/// Notifies the first application of `node` that `peer` is gone.
pub(super) fn notify_of_the_end(node: &Node, peer: NodeAddress) {
    let header = Header::new(KIND, Tid::new(node.address(), AppAddress::NDL), node.tid(1));
    let event = Message::new(header, Bytes::from_static(b"its end"));
    node_down_events::notify(&node.state, About::End(peer), event).expect("there is room");
}

fn from_nine(node: &Node, payload: &[u8]) -> Message {
    let mut message = node.message(node.tid(1), payload);
    message.header.source.node = NINE;
    message
}

/// Waits until the node has read all earlier frames of the peer.
async fn has_read(peer: &mut ByHand, node: &Node) {
    let gncl = |node| Tid::new(node, AppAddress::GNCL);
    let ping = Header::new(Kind::GNCL_PING, gncl(NINE), gncl(node.address()));
    peer.send(&Message::new(ping, Bytes::new())).await;
    while peer.receive().await.header.kind != Kind::GNCL_PONG {}
}

#[test]
fn nothing_of_an_ended_incarnation_is_accepted() {
    run(async {
        let mut node = Node::start(1).await;
        let mut inbox = node.app(1);
        let mut peer = ByHand::linked_to(&mut node).await;
        peer.send(&from_nine(&node, b"the last one")).await;
        assert_eq!(next("the last message", &mut inbox).await.payload[..], *b"the last one");
        // Another incarnation does not affect it.
        node.state.store.fence(NINE, Incarnation(incarnation_of(&node, NINE).0 + 1));
        peer.send(&from_nine(&node, b"still")).await;
        assert_eq!(next("a message", &mut inbox).await.payload[..], *b"still");
        node.state.store.fence(NINE, incarnation_of(&node, NINE));
        peer.send(&from_nine(&node, b"too late")).await;
        has_read(&mut peer, &node).await;
        assert!(inbox.next().now_or_never().is_none());
        // Messages to it are not accepted either, although GNCL has no report of its end.
        let sent =
            node.state.ctx.router.send(node.message(Tid::new(NINE, AppAddress::new(1)), b"for nobody"));
        assert_eq!(sent, Err(Rejection::NoSuchNode));
    });
}

#[test]
fn end_of_a_leaving_node_follows_its_messages() {
    run(async {
        let mut node = Node::start(1).await;
        actix::spawn(node_down_events::run_retries(node.state.clone()));
        let mut inbox = node.app(1);
        let mut peer = ByHand::linked_to(&mut node).await;
        node.state.store.record_departure(Time::now(), NINE, incarnation_of(&node, NINE));
        notify_of_the_end(&node, NINE);
        for said in [&b"one"[..], b"two"] {
            peer.send(&from_nine(&node, said)).await;
            assert_eq!(next("its message", &mut inbox).await.payload[..], *said);
        }
        node.lose(NINE);
        assert_eq!(next("its end", &mut inbox).await.payload[..], *b"its end");
    });
}

#[test]
fn end_of_a_lost_node_follows_held_messages() {
    run(async {
        let (a, b, mut slow) = credit::pair().await;
        actix::spawn(node_down_events::run_retries(b.state.clone()));
        credit::fill(&a, &b).await;
        b.state.store.fence(a.address(), incarnation_of(&b, a.address()));
        notify_of_the_end(&b, a.address());
        let mut came = 0_u64;
        loop {
            let message = next("what waited, and the end", &mut slow).await;
            if message.payload[..] == *b"its end" {
                break;
            }
            assert_eq!(message.payload[..], came.to_le_bytes());
            came += 1;
        }
        assert!(came > credit::MAILBOX as u64, "{came}");
        assert!(slow.next().now_or_never().is_none());
    });
}

#[test]
fn later_incarnations_messages_follow_the_earlier_ones() {
    run(async {
        let mut node = Node::start(1).await;
        let mut slow = node.app_of(1, 2);
        let mut earlier = ByHand::linked_to(&mut node).await;
        for said in 0..5_u8 {
            earlier.send(&from_nine(&node, &[said])).await;
        }
        has_read(&mut earlier, &node).await;
        let incarnation = Incarnation(incarnation_of(&node, NINE).0 + 1);
        let hello = Introduction { incarnation, ..introduction(node.address()) };
        let mut later = ByHand::greeting(&node, &hello).await;
        for said in 5..8_u8 {
            later.send(&from_nine(&node, &[said])).await;
        }
        has_read(&mut later, &node).await;
        for expected in 0..8_u8 {
            assert_eq!(next("a message of either incarnation", &mut slow).await.payload[..], [expected]);
        }
        assert!(slow.next().now_or_never().is_none());
    });
}

/// Waits until nothing of `peer` is left for an application of `node`. The notifications of changes are sufficient for
/// this; nothing is polled.
async fn owes_nothing(node: &Node, peer: NodeAddress) {
    let gncl = &node.state.store;
    within("the last message", async {
        while gncl.outstanding(peer) != OutstandingDestinations::NONE {
            gncl.fewer_outstanding.notified().await;
        }
    })
    .await;
}

#[test]
fn waiter_for_the_end_is_notified_without_polling() {
    run(async {
        let mut node = Node::start(1).await;
        let mut inbox = node.app(1);
        let _peer = ByHand::linked_to(&mut node).await;
        node.state.store.record_departure(Time::now(), NINE, incarnation_of(&node, NINE));
        notify_of_the_end(&node, NINE);
        let pause = node_down_events::deliver_due(&node.state, Time::now());
        assert_eq!(pause, Some(node_down_events::CHECK_PERIOD));
        let news = &node.state.store.fewer_outstanding;
        assert!(news.notified().now_or_never().is_some(), "it was told something");
        assert!(news.notified().now_or_never().is_none(), "nothing has come");
        assert!(inbox.next().now_or_never().is_none());
        node.state.store.fence(NINE, incarnation_of(&node, NINE));
        assert!(news.notified().now_or_never().is_some(), "its end");
        assert_eq!(node.state.store.outstanding(NINE), OutstandingDestinations::NONE);
        assert_eq!(node_down_events::deliver_due(&node.state, Time::now()), None);
        assert_eq!(next("its end", &mut inbox).await.payload[..], *b"its end");
    });
}

#[test]
fn waiter_for_the_last_held_message_is_notified() {
    run(async {
        let (a, b, mut slow) = credit::pair().await;
        credit::fill(&a, &b).await;
        b.state.store.fence(a.address(), incarnation_of(&b, a.address()));
        assert!(b.state.store.outstanding(a.address()).contains(b.tid(1).app));
        // A message in hand of the Bulk thread may be for any destination.
        within("the message in hand to be put down", async {
            while b.state.store.outstanding(a.address()).contains(b.tid(2).app) {
                tokio::task::yield_now().await;
            }
        })
        .await;
        let takes = async { while slow.next().await.is_some() {} };
        tokio::select! {
            () = owes_nothing(&b, a.address()) => {}
            () = takes => panic!("its mailbox ended"),
        }
    });
}

#[test]
fn leaving_node_ends_when_its_time_is_over() {
    run(async {
        let mut node = Node::start(1).await;
        let mut inbox = node.app(1);
        let _peer = ByHand::linked_to(&mut node).await;
        let now = Time::now();
        node.state.store.record_departure(now, NINE, incarnation_of(&node, NINE));
        notify_of_the_end(&node, NINE);
        let later = Time::now() + node_down_events::LEAVE_MAX;
        assert_eq!(node_down_events::deliver_due(&node.state, later), None);
        assert_eq!(next("its end", &mut inbox).await.payload[..], *b"its end");
    });
}
