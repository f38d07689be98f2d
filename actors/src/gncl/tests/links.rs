//! Links that break, are made again, and end in order.

use std::{
    cell::RefCell,
    net::Ipv4Addr,
    rc::Rc,
    sync::{Arc, atomic::Ordering},
    time::Duration,
};

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    tid::Tid,
    time::Time,
    wire::Kind,
};
use socket2::SockRef;

use super::bench::{ByHand, Cable, NINE, Node, next, pair, run, within};
use crate::{
    accept_pace::Pace,
    gncl::{LinkFact, core::write, lent::Lent, link, listener, peer::frame},
    session::Ack,
    sync,
};

#[test]
fn two_nodes_that_find_each_other_at_once_have_one_link_and_use_it_both_ways() {
    run(async {
        let (a, b) = pair().await;
        let (mut at_a, mut at_b) = (a.app(1), b.app(1));
        for number in 0..100u8 {
            a.send(b.tid(1), &[number]);
            b.send(a.tid(1), &[number]);
        }
        for number in 0..100u8 {
            let there = next("a message at b", &mut at_b).await;
            assert_eq!((there.header.source, &there.payload[..]), (a.tid(1), &[number][..]));
            let here = next("a message at a", &mut at_a).await;
            assert_eq!((here.header.source, &here.payload[..]), (b.tid(1), &[number][..]));
        }
    });
}

#[test]
fn a_short_break_loses_nothing_that_was_not_sent_and_keeps_the_order() {
    run(async {
        let (mut a, b) = (Node::start(1).await, Node::start(2).await);
        let mut inbox = b.app(1);
        let cable = Cable::to(b.listens_at()).await;
        a.find(b.address(), cable.address);
        a.up().await;
        for round in 0..5u8 {
            for number in 0..50 {
                a.send(b.tid(1), &[round, number]);
            }
            for number in 0..25 {
                assert_eq!(next("a message", &mut inbox).await.payload[..], [round, number]);
            }
            for number in 25..50 {
                assert_eq!(next("a message", &mut inbox).await.payload[..], [round, number]);
            }
            cable.cut();
            a.broken().await;
        }
        for number in 0..50 {
            a.send(b.tid(1), &[99, number]);
        }
        for number in 0..50 {
            assert_eq!(next("a message after the last break", &mut inbox).await.payload[..], [99, number]);
        }
    });
}

#[test]
fn what_was_sent_and_not_confirmed_is_unknown_when_the_node_is_lost() {
    run(async {
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        let to = Tid::new(NINE, node.tid(5).app);
        for correlation in [1, 2] {
            node.stores.router.send(node.confirmed(to, correlation)).unwrap();
        }
        let first = peer.hear().await;
        peer.hear().await;
        peer.say(&ByHand::outcome(&first, Outcome::Delivered)).await;
        assert_eq!(next("the first outcome", &mut node.settled).await, (1, Outcome::Delivered));
        drop(peer);
        node.broken().await;
        node.lose(NINE);
        assert_eq!(next("the second outcome", &mut node.settled).await, (2, Outcome::Unknown));
    });
}

#[test]
fn cuts_in_full_flow_lose_double_and_reorder_nothing_and_every_confirmed_message_has_its_outcome() {
    run(async {
        let (mut a, b) = (Node::start(1).await, Node::start(2).await);
        let (mut at_a, mut at_b) = (a.app(1), b.app(1));
        let cable = Cable::to(b.listens_at()).await;
        a.find(b.address(), cable.address);
        a.up().await;
        let (mut there, mut back, mut told) = (0u64, 0u64, 0u64);
        for round in 1..=40u64 {
            for _ in 0..50 {
                there += 1;
                a.stores.router.send(a.confirmed(b.tid(1), there)).expect("there is room for it");
                back += 1;
                b.send(a.tid(1), &back.to_le_bytes());
            }
            if round % 2 == 0 {
                // Some of it is on the wire, some in sockets, some not yet sent.
                cable.cut();
            }
            for number in there - 49..=there {
                let message = next("a message at b", &mut at_b).await;
                assert_eq!(message.payload[..], number.to_le_bytes());
                message.receipt.expect("it is to be confirmed").settle(Outcome::Delivered);
            }
            for number in back - 49..=back {
                assert_eq!(next("a message at a", &mut at_a).await.payload[..], number.to_le_bytes());
            }
        }
        while told < there {
            let (_, outcome) = next("an outcome", &mut a.settled).await;
            assert_eq!(outcome, Outcome::Delivered);
            told += 1;
        }
    });
}

#[test]
fn a_layer_that_ends_in_full_flow_on_either_side_loses_doubles_and_reorders_nothing() {
    run(async {
        let (mut a, mut b) = pair().await;
        let mut at_b = b.app(1);
        let mut number = 0u64;
        for round in 0..10u64 {
            for _ in 0..200 {
                number += 1;
                a.send(b.tid(1), &number.to_le_bytes());
            }
            if round % 2 == 0 {
                a.stop_layer();
                a.start_layer().await;
                // There is no NDL here that would know it still.
                a.find(b.address(), b.listens_at());
            } else {
                b.stop_layer();
                b.start_layer().await;
                b.find(a.address(), a.listens_at());
            }
            for expected in number - 199..=number {
                let message = next("a message", &mut at_b).await;
                assert_eq!(message.payload[..], expected.to_le_bytes());
            }
        }
    });
}

#[test]
fn a_peer_that_skips_or_repeats_a_number_is_told_so_and_its_connection_ends() {
    run(async {
        for step in [-1i32, 1] {
            let mut node = Node::start(1).await;
            let mut inbox = node.app(1);
            let mut peer = ByHand::linked_to(&mut node).await;
            let mut message = node.message(node.tid(1), b"first");
            message.header.source = Tid::new(NINE, node.tid(1).app);
            peer.say(&message).await;
            next("the first message", &mut inbox).await;
            peer.skip(step);
            peer.say(&message).await;
            let refusal = peer.refusal().await;
            assert!(refusal.sentence.contains("2 is the next one"), "{}", refusal.sentence);
        }
    });
}

#[test]
fn a_message_that_is_longer_than_this_node_takes_is_refused_also_where_gncls_own_words_may_be_longer() {
    run(async {
        let mut node = Node::start_with(1, |config| config.payload_max = 256).await;
        let mut inbox = node.app(1);
        let mut peer = ByHand::linked_to(&mut node).await;
        let message = |length| {
            let mut message = node.message(node.tid(1), &vec![7; length]);
            message.header.source = Tid::new(NINE, node.tid(1).app);
            message
        };
        peer.say(&message(256)).await;
        next("the one that is short enough", &mut inbox).await;
        peer.say(&message(257)).await;
        let refusal = peer.refusal().await;
        assert!(refusal.sentence.contains("257 bytes"), "{}", refusal.sentence);
    });
}

#[test]
fn gncls_own_words_have_a_bound_of_their_own_where_messages_may_be_longer() {
    run(async {
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        let held = (0..5_000).collect();
        let ack = Ack { memory: 1, epoch: 1, of: 0, next: 1, change: 9, held, room: None };
        peer.say(&frame(NINE, node.address(), Kind::GNCL_ACK, write(&ack))).await;
        let refusal = peer.refusal().await;
        assert!(refusal.sentence.contains("4096"), "{}", refusal.sentence);
    });
}

#[test]
fn a_lost_node_loses_what_waits_for_it_and_takes_nothing_more() {
    run(async {
        let mut node = Node::start(1).await;
        let peer = ByHand::linked_to(&mut node).await;
        drop(peer);
        node.broken().await;
        let to = Tid::new(NINE, node.tid(5).app);
        node.stores.router.send(node.confirmed(to, 1)).expect("it waits for the peer to come back");
        node.lose(NINE);
        assert_eq!(next("the outcome", &mut node.settled).await, (1, Outcome::PeerLost));
        assert_eq!(node.stores.router.send(node.message(to, b"")), Err(Rejection::NoSuchNode));
    });
}

#[test]
fn a_ping_is_answered() {
    run(async {
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        peer.say(&frame(NINE, node.address(), Kind::GNCL_PING, bytes::Bytes::new())).await;
        assert_eq!(peer.hear().await.header.kind, Kind::GNCL_PONG);
    });
}

#[test]
fn a_silent_peer_is_pinged() {
    run(async {
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        assert_eq!(peer.hear().await.header.kind, Kind::GNCL_PING);
    });
}

#[test]
fn a_node_that_leaves_says_goodbye_last_and_its_peer_knows_that_it_left() {
    run(async {
        let (mut a, mut b) = pair().await;
        let mut inbox = b.app(1);
        a.send(b.tid(1), b"the first word");
        next("the first word", &mut inbox).await;
        // What is sent now is on the wire at once: this layer's thread ends without the time that a supervisor gives.
        a.send(b.tid(1), b"the last word");
        a.stores.stopping.store(true, Ordering::Relaxed);
        a.stop_layer();
        assert_eq!(&next("the last word", &mut inbox).await.payload[..], b"the last word");
        let left = b.fact_that(|fact| !matches!(fact, LinkFact::LinkUp { .. })).await;
        assert!(matches!(left, LinkFact::PeerLeft { node, .. } if node == a.address()));
    });
}

#[test]
fn a_restarted_layer_listens_where_it_did_and_sends_what_waited_in_order() {
    run(async {
        let (mut a, mut b) = pair().await;
        let mut inbox = b.app(1);
        let before = a.listens_at();
        a.stop_layer();
        b.broken().await;
        for number in 0..20 {
            a.send(b.tid(1), &[number]);
        }
        a.start_layer().await;
        assert_eq!(a.listens_at(), before);
        for number in 0..20 {
            assert_eq!(next("a message that waited", &mut inbox).await.payload[..], [number]);
        }
    });
}

#[test]
fn a_layer_that_hung_and_comes_back_leaves_the_links_of_its_successor_alone() {
    run(async {
        let (mut a, b) = pair().await;
        let hung = a.hang_layer().await;
        a.start_layer().await;
        a.up().await;
        let peer = a.stores.gncl.peer(b.address()).expect("it is linked");
        let is_linked = || peer.ways().iter().all(|way| way.outlet.is_connected());
        within("all connections", async {
            while !is_linked() {
                tokio::task::yield_now().await;
            }
        })
        .await;
        hung.comes_back();
        assert!(is_linked());
    });
}

#[test]
fn the_sync_manager_hears_that_the_links_of_a_former_layer_are_down() {
    run(async {
        let (mut a, b) = pair().await;
        a.stop_layer();
        // What its first life has said is read; nothing of `b` comes back.
        let mut told = Box::pin(a.stores.posts.sync.attach());
        while !matches!(next("what was said", &mut told).await, sync::Event::Link(LinkFact::LinkUp { .. })) {}
        drop(b);
        a.start_layer().await;
        let first = next("what the second life says", &mut told).await;
        assert!(matches!(first, sync::Event::Link(LinkFact::LinkBroken { .. })), "{first:?}");
    });
}

#[test]
fn a_layer_whose_post_was_full_hears_later_that_a_link_stands() {
    run(async {
        // given: a sync manager that reads nothing
        let (mut a, b) = (Node::start(1).await, Node::start(2).await);
        while a.stores.posts.sync.post(sync::Event::Monitors).is_ok() {}
        // when
        a.find(b.address(), b.listens_at());
        a.up().await;
        a.counted("a layer's post is full").await;
        // then
        let mut told = Box::pin(a.stores.posts.sync.attach());
        let fact = loop {
            if let sync::Event::Link(fact) = next("what the sync manager is told", &mut told).await {
                break fact;
            }
        };
        assert!(matches!(fact, LinkFact::LinkUp { node, .. } if node == b.address()), "{fact:?}");
    });
}

#[test]
fn both_ends_of_a_connection_give_it_up_when_nothing_is_taken_any_more() {
    run(async {
        let give_up = Duration::from_millis(1_234);
        let listener = listener::listen(([127, 0, 0, 1], 0).into()).expect("loopback has a free port");
        let address = listener.local_addr().expect("it is bound");
        let listener = Lent::of(&Arc::new(listener)).expect("it does not block");
        let pace = Rc::new(RefCell::new(Pace::new(Time::now())));
        let mut accepted = Box::pin(listener::accepted(listener, give_up, pace));
        let dialled = link::connect(link::Ends { to: address, from: None, segment_max: None }, give_up)
            .await
            .expect("it listens");
        let accepted = next("a connection", &mut accepted).await.expect("it is accepted");
        for end in [&dialled, &accepted] {
            assert_eq!(SockRef::from(end).tcp_user_timeout().expect("the system says it"), Some(give_up));
        }
    });
}

#[test]
fn a_peer_is_taken_while_more_connections_than_there_may_be_say_nothing() {
    run(async {
        let mut node = Node::start_with(1, |config| config.gncl.strangers_max = 4).await;
        let mut silent = Vec::new();
        for _ in 0..200 {
            silent.push(ByHand::dial(&node).await);
        }
        let _peer = ByHand::linked_to(&mut node).await;
        assert!(node.stores.gncl.refusals.of("too many strangers") > 0);
    });
}

#[test]
fn two_layers_cannot_have_one_port_and_the_second_says_so() {
    run(async {
        let a = Node::start(1).await;
        let port = a.listens_at().port();
        let error = listener::listen(([127, 0, 0, 1], port).into()).unwrap_err();
        assert_eq!(error.kind(), std::io::ErrorKind::AddrInUse);
    });
}

#[test]
fn a_link_whose_way_is_gone_is_back_over_another_address_of_its_peer_and_nothing_is_lost() {
    run(async {
        let mut a = Node::start(1).await;
        let further = Ipv4Addr::new(127, 0, 0, 2);
        let b = Node::start_with(2, |config| config.gncl.further = vec![further]).await;
        let other_way = b.stores.gncl_further.get().expect("GNCL listens")[0];
        assert_eq!(*other_way.ip(), further);
        let mut inbox = b.app(1);
        let cable = Cable::to(b.listens_at()).await;
        a.find_at(b.address(), vec![cable.address, other_way.into()]);
        a.up().await;
        for number in 0..100u8 {
            if number == 50 {
                cable.cut();
                cable.remove();
                a.broken().await;
            }
            a.send(b.tid(1), &[number]);
        }
        for number in 0..100u8 {
            assert_eq!(next("a message", &mut inbox).await.payload[..], [number]);
        }
        a.up().await;
    });
}

#[cfg(target_os = "linux")]
#[test]
fn an_address_that_this_host_does_not_have_yet_keeps_no_node_from_its_start() {
    run(async {
        // 192.0.2.0/24 is for documentation.
        let absent = Ipv4Addr::new(192, 0, 2, 1);
        let node = Node::start_with(1, |config| config.gncl.further = vec![absent]).await;
        let further = node.stores.gncl_further.get().expect("GNCL listens");
        assert_eq!(further.iter().map(|address| *address.ip()).collect::<Vec<_>>(), [absent]);
    });
}
