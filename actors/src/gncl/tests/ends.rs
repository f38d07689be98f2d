//! What is told of a peer's end comes behind its last message.

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
use crate::{
    aftermath,
    gncl::{core::Introduction, owed::Owed},
};

/// The incarnation of a peer that is linked.
pub(super) fn life(node: &Node, peer: NodeAddress) -> Incarnation {
    node.stores.gncl.peer(peer).expect("it is linked").incarnation
}

/// Tells the first application of `node` that `peer` is gone.
pub(super) fn tell_the_end(node: &Node, peer: NodeAddress) {
    let header = Header::new(KIND, Tid::new(node.address(), AppAddress::NDL), node.tid(1));
    let event = Message::new(header, Bytes::from_static(b"its end"));
    aftermath::tell(&node.stores, About::End(peer), event).expect("there is room");
}

fn from_nine(node: &Node, payload: &[u8]) -> Message {
    let mut message = node.message(node.tid(1), payload);
    message.header.source.node = NINE;
    message
}

/// The node has read all that the peer has said before.
async fn has_read(peer: &mut ByHand, node: &Node) {
    let gncl = |node| Tid::new(node, AppAddress::GNCL);
    let ping = Header::new(Kind::GNCL_PING, gncl(NINE), gncl(node.address()));
    peer.say(&Message::new(ping, Bytes::new())).await;
    while peer.hear().await.header.kind != Kind::GNCL_PONG {}
}

#[test]
fn of_a_life_that_is_over_nothing_more_is_taken() {
    run(async {
        let mut node = Node::start(1).await;
        let mut inbox = node.app(1);
        let mut peer = ByHand::linked_to(&mut node).await;
        peer.say(&from_nine(&node, b"the last one")).await;
        assert_eq!(next("the last message", &mut inbox).await.payload[..], *b"the last one");
        // Another life is none of its business.
        node.stores.gncl.fence(NINE, Incarnation(life(&node, NINE).0 + 1));
        peer.say(&from_nine(&node, b"still")).await;
        assert_eq!(next("a message", &mut inbox).await.payload[..], *b"still");
        node.stores.gncl.fence(NINE, life(&node, NINE));
        peer.say(&from_nine(&node, b"too late")).await;
        has_read(&mut peer, &node).await;
        assert!(inbox.next().now_or_never().is_none());
        // Nor is anything taken for it, though GNCL has not heard of its end.
        let sent = node.stores.router.send(node.message(Tid::new(NINE, AppAddress::new(1)), b"for nobody"));
        assert_eq!(sent, Err(Rejection::NoSuchNode));
    });
}

#[test]
fn what_is_told_of_a_node_that_leaves_waits_for_what_it_still_sends() {
    run(async {
        let mut node = Node::start(1).await;
        actix::spawn(aftermath::carry_on(node.stores.clone()));
        let mut inbox = node.app(1);
        let mut peer = ByHand::linked_to(&mut node).await;
        node.stores.gncl.leaves(Time::now(), NINE, life(&node, NINE));
        tell_the_end(&node, NINE);
        for said in [&b"one"[..], b"two"] {
            peer.say(&from_nine(&node, said)).await;
            assert_eq!(next("its message", &mut inbox).await.payload[..], *said);
        }
        node.lose(NINE);
        assert_eq!(next("its end", &mut inbox).await.payload[..], *b"its end");
    });
}

#[test]
fn what_is_told_of_a_node_that_is_lost_comes_behind_what_waits_for_a_slow_application() {
    run(async {
        let (a, b, mut slow) = credit::pair().await;
        actix::spawn(aftermath::carry_on(b.stores.clone()));
        credit::fill(&a, &b).await;
        b.stores.gncl.fence(a.address(), life(&b, a.address()));
        tell_the_end(&b, a.address());
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
fn what_comes_of_a_later_life_comes_behind_what_waits_of_the_earlier_one() {
    run(async {
        let mut node = Node::start(1).await;
        let mut slow = node.app_of(1, 2);
        let mut earlier = ByHand::linked_to(&mut node).await;
        for said in 0..5_u8 {
            earlier.say(&from_nine(&node, &[said])).await;
        }
        has_read(&mut earlier, &node).await;
        let incarnation = Incarnation(life(&node, NINE).0 + 1);
        let hello = Introduction { incarnation, ..introduction(node.address()) };
        let mut later = ByHand::greeting(&node, &hello).await;
        for said in 5..8_u8 {
            later.say(&from_nine(&node, &[said])).await;
        }
        has_read(&mut later, &node).await;
        for expected in 0..8_u8 {
            assert_eq!(next("a message of either life", &mut slow).await.payload[..], [expected]);
        }
        assert!(slow.next().now_or_never().is_none());
    });
}

/// Nothing of `peer` may still come to an application of `node`: whoever is told of each change, and looks at nothing else, knows.
async fn owes_nothing(node: &Node, peer: NodeAddress) {
    let gncl = &node.stores.gncl;
    within("the last message", async {
        while gncl.owed(peer) != Owed::NOBODY {
            gncl.fewer_owed.notified().await;
        }
    })
    .await;
}

#[test]
fn who_waits_for_the_end_of_a_life_that_leaves_is_told_of_it_and_looks_at_nothing_meanwhile() {
    run(async {
        let mut node = Node::start(1).await;
        let mut inbox = node.app(1);
        let _peer = ByHand::linked_to(&mut node).await;
        node.stores.gncl.leaves(Time::now(), NINE, life(&node, NINE));
        tell_the_end(&node, NINE);
        let pause = aftermath::tell_whose_turn_has_come(&node.stores, Time::now());
        assert_eq!(pause, Some(aftermath::LOOK_PERIOD));
        let news = &node.stores.gncl.fewer_owed;
        assert!(news.notified().now_or_never().is_some(), "it was told something");
        assert!(news.notified().now_or_never().is_none(), "nothing has come");
        assert!(inbox.next().now_or_never().is_none());
        node.stores.gncl.fence(NINE, life(&node, NINE));
        assert!(news.notified().now_or_never().is_some(), "its end");
        assert_eq!(node.stores.gncl.owed(NINE), Owed::NOBODY);
        assert_eq!(aftermath::tell_whose_turn_has_come(&node.stores, Time::now()), None);
        assert_eq!(next("its end", &mut inbox).await.payload[..], *b"its end");
    });
}

#[test]
fn who_waits_for_the_last_message_to_a_slow_application_is_told_when_it_has_come() {
    run(async {
        let (a, b, mut slow) = credit::pair().await;
        credit::fill(&a, &b).await;
        b.stores.gncl.fence(a.address(), life(&b, a.address()));
        assert!(b.stores.gncl.owed(a.address()).has(b.tid(1).app));
        // What the thread of Bulk has in hand may be for anyone.
        within("the message in hand to be put down", async {
            while b.stores.gncl.owed(a.address()).has(b.tid(2).app) {
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
fn who_left_and_still_sends_is_over_when_his_time_is() {
    run(async {
        let mut node = Node::start(1).await;
        let mut inbox = node.app(1);
        let _peer = ByHand::linked_to(&mut node).await;
        let now = Time::now();
        node.stores.gncl.leaves(now, NINE, life(&node, NINE));
        tell_the_end(&node, NINE);
        let later = Time::now() + aftermath::LEAVE_MAX;
        assert_eq!(aftermath::tell_whose_turn_has_come(&node.stores, later), None);
        assert_eq!(next("its end", &mut inbox).await.payload[..], *b"its end");
    });
}
