//! Links that break, are restored, and end in order.

use std::{
    cell::RefCell,
    net::Ipv4Addr,
    rc::Rc,
    sync::{Arc, atomic::Ordering},
    time::Duration,
};

use sinew_model::{accept_limiter::AcceptLimiter, events::SyncEvent, facts::LinkFact};
use sinew_runtime::{
    outcome::{Outcome, Rejection},
    tid::Tid,
    time::Time,
    wire::Kind,
};
use sinew_session::Ack;
use socket2::SockRef;

use super::bench::{ByHand, Cable, NINE, Node, next, pair, run, within};
use crate::{core::write, frame::frame, link, listener, shared_socket::SharedSocket};

#[test]
fn simultaneous_discovery_makes_one_link_for_both_directions() {
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
fn short_break_loses_no_unsent_message() {
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
fn unconfirmed_messages_to_a_lost_node_are_unknown() {
    run(async {
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        let to = Tid::new(NINE, node.tid(5).app);
        for correlation in [1, 2] {
            node.state.ctx.router.send(node.confirmed(to, correlation)).unwrap();
        }
        let first = peer.receive().await;
        peer.receive().await;
        peer.send(&ByHand::outcome(&first, Outcome::Delivered)).await;
        assert_eq!(next("the first outcome", &mut node.settled).await, (1, Outcome::Delivered));
        drop(peer);
        node.broken().await;
        node.lose(NINE);
        assert_eq!(next("the second outcome", &mut node.settled).await, (2, Outcome::Unknown));
    });
}

#[test]
fn cuts_in_full_flow_lose_duplicate_and_reorder_nothing() {
    run(async {
        let (mut a, b) = (Node::start(1).await, Node::start(2).await);
        let (mut at_a, mut at_b) = (a.app(1), b.app(1));
        let cable = Cable::to(b.listens_at()).await;
        a.find(b.address(), cable.address);
        a.up().await;
        let (mut there, mut back, mut reported) = (0u64, 0u64, 0u64);
        for round in 1..=40u64 {
            for _ in 0..50 {
                there += 1;
                a.state.ctx.router.send(a.confirmed(b.tid(1), there)).expect("there is room for it");
                back += 1;
                b.send(a.tid(1), &back.to_le_bytes());
            }
            if round % 2 == 0 {
                // Some messages are on the wire, some in sockets, some not yet sent.
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
        while reported < there {
            let (_, outcome) = next("an outcome", &mut a.settled).await;
            assert_eq!(outcome, Outcome::Delivered);
            reported += 1;
        }
    });
}

#[test]
fn layer_restart_in_full_flow_loses_duplicates_reorders_nothing() {
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
                // There is no NDL here that still knows it.
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
fn skipped_or_repeated_number_ends_the_connection() {
    run(async {
        for step in [-1i32, 1] {
            let mut node = Node::start(1).await;
            let mut inbox = node.app(1);
            let mut peer = ByHand::linked_to(&mut node).await;
            let mut message = node.message(node.tid(1), b"first");
            message.header.source = Tid::new(NINE, node.tid(1).app);
            peer.send(&message).await;
            next("the first message", &mut inbox).await;
            peer.skip(step);
            peer.send(&message).await;
            let refusal = peer.refusal().await;
            assert!(refusal.sentence.contains("2 is the next one"), "{}", refusal.sentence);
        }
    });
}

#[test]
fn too_long_message_is_refused_despite_longer_gncl_frames() {
    run(async {
        let mut node = Node::start_with(1, |config| config.payload_max = 256).await;
        let mut inbox = node.app(1);
        let mut peer = ByHand::linked_to(&mut node).await;
        let message = |length| {
            let mut message = node.message(node.tid(1), &vec![7; length]);
            message.header.source = Tid::new(NINE, node.tid(1).app);
            message
        };
        peer.send(&message(256)).await;
        next("the one that is short enough", &mut inbox).await;
        peer.send(&message(257)).await;
        let refusal = peer.refusal().await;
        assert!(refusal.sentence.contains("257 bytes"), "{}", refusal.sentence);
    });
}

#[test]
fn gncl_frames_have_their_own_length_bound() {
    run(async {
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        let held = (0..5_000).collect();
        let ack = Ack { receiver_id: 1, epoch: 1, peer_epoch: 0, next: 1, change: 9, held, room: None };
        peer.send(&frame(NINE, node.address(), Kind::GNCL_ACK, write(&ack))).await;
        let refusal = peer.refusal().await;
        assert!(refusal.sentence.contains("4096"), "{}", refusal.sentence);
    });
}

#[test]
fn lost_node_drops_its_queue_and_accepts_no_more() {
    run(async {
        let mut node = Node::start(1).await;
        let peer = ByHand::linked_to(&mut node).await;
        drop(peer);
        node.broken().await;
        let to = Tid::new(NINE, node.tid(5).app);
        node.state.ctx.router.send(node.confirmed(to, 1)).expect("it waits for the peer to come back");
        node.lose(NINE);
        assert_eq!(next("the outcome", &mut node.settled).await, (1, Outcome::PeerLost));
        assert_eq!(node.state.ctx.router.send(node.message(to, b"")), Err(Rejection::NoSuchNode));
    });
}

#[test]
fn ping_is_answered() {
    run(async {
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        peer.send(&frame(NINE, node.address(), Kind::GNCL_PING, bytes::Bytes::new())).await;
        assert_eq!(peer.receive().await.header.kind, Kind::GNCL_PONG);
    });
}

#[test]
fn silent_peer_is_pinged() {
    run(async {
        let mut node = Node::start(1).await;
        let mut peer = ByHand::linked_to(&mut node).await;
        assert_eq!(peer.receive().await.header.kind, Kind::GNCL_PING);
    });
}

#[test]
fn leaving_node_sends_goodbye_last_and_is_reported_left() {
    run(async {
        let (mut a, mut b) = pair().await;
        let mut inbox = b.app(1);
        a.send(b.tid(1), b"the first word");
        next("the first word", &mut inbox).await;
        // A message sent now is on the wire at once: this layer's thread ends without the grace time of a supervisor.
        a.send(b.tid(1), b"the last word");
        a.state.ctx.stopping.store(true, Ordering::Relaxed);
        a.stop_layer();
        assert_eq!(&next("the last word", &mut inbox).await.payload[..], b"the last word");
        let left = b.fact_that(|fact| !matches!(fact, LinkFact::LinkUp { .. })).await;
        assert!(matches!(left, LinkFact::PeerLeft { node, .. } if node == a.address()));
    });
}

#[test]
fn restarted_layer_keeps_its_address_and_sends_in_order() {
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
fn resumed_hung_layer_leaves_its_successors_links_alone() {
    run(async {
        let (mut a, b) = pair().await;
        let hung = a.hang_layer().await;
        a.start_layer().await;
        a.up().await;
        let peer = a.state.store.peer(b.address()).expect("it is linked");
        let is_linked = || peer.sessions().iter().all(|session| session.outlet.is_connected());
        within("all connections", async {
            while !is_linked() {
                tokio::task::yield_now().await;
            }
        })
        .await;
        hung.resume();
        assert!(is_linked());
    });
}

#[test]
fn sync_manager_is_notified_of_a_former_layers_links() {
    run(async {
        let (mut a, b) = pair().await;
        a.stop_layer();
        // The events of its first instance are read; `b` does not return.
        let mut events = Box::pin(a.state.ctx.event_queues.sync.attach());
        while !matches!(
            next("the link to be reported", &mut events).await,
            SyncEvent::Link(LinkFact::LinkUp { .. })
        ) {}
        drop(b);
        a.start_layer().await;
        let first = next("the first event of the second incarnation", &mut events).await;
        assert!(matches!(first, SyncEvent::Link(LinkFact::LinkBroken { .. })), "{first:?}");
    });
}

#[test]
fn full_event_queue_receives_the_link_up_later() {
    run(async {
        // given: a sync manager that reads nothing
        let (mut a, b) = (Node::start(1).await, Node::start(2).await);
        while a.state.ctx.event_queues.sync.post(SyncEvent::Monitors).is_ok() {}
        // when
        a.find(b.address(), b.listens_at());
        a.up().await;
        a.counted("a layer's event queue is full").await;
        // then
        let mut events = Box::pin(a.state.ctx.event_queues.sync.attach());
        let fact = loop {
            if let SyncEvent::Link(fact) = next("an event for the sync manager", &mut events).await {
                break fact;
            }
        };
        assert!(matches!(fact, LinkFact::LinkUp { node, .. } if node == b.address()), "{fact:?}");
    });
}

#[test]
fn both_ends_give_up_an_unread_connection() {
    run(async {
        let give_up = Duration::from_millis(1_234);
        let listener = listener::listen(([127, 0, 0, 1], 0).into()).expect("loopback has a free port");
        let address = listener.local_addr().expect("it is bound");
        let listener = SharedSocket::register(&Arc::new(listener)).expect("it does not block");
        let limiter = Rc::new(RefCell::new(AcceptLimiter::new(Time::now())));
        let mut accepted = Box::pin(listener::accepted(listener, give_up, limiter));
        let dialled =
            link::connect(link::DialAddresses { to: address, from: None, segment_max: None }, give_up)
                .await
                .expect("it listens");
        let accepted = next("a connection", &mut accepted).await.expect("it is accepted");
        for end in [&dialled, &accepted] {
            assert_eq!(SockRef::from(end).tcp_user_timeout().expect("the system says it"), Some(give_up));
        }
    });
}

#[test]
fn peer_is_accepted_despite_too_many_silent_connections() {
    run(async {
        let mut node = Node::start_with(1, |config| config.gncl.strangers_max = 4).await;
        let mut silent = Vec::new();
        for _ in 0..200 {
            silent.push(ByHand::dial(&node).await);
        }
        let _peer = ByHand::linked_to(&mut node).await;
        assert!(node.state.store.refusals.of("too many strangers") > 0);
    });
}

#[test]
fn second_layer_on_one_port_fails_with_a_reason() {
    run(async {
        let a = Node::start(1).await;
        let port = a.listens_at().port();
        let error = listener::listen(([127, 0, 0, 1], port).into()).unwrap_err();
        assert_eq!(error.kind(), std::io::ErrorKind::AddrInUse);
    });
}

#[test]
fn link_moves_to_another_address_and_loses_nothing() {
    run(async {
        let mut a = Node::start(1).await;
        let further = Ipv4Addr::new(127, 0, 0, 2);
        let b = Node::start_with(2, |config| config.gncl.further = vec![further]).await;
        let other_way = b.state.ctx.listens.further.get().expect("GNCL listens")[0];
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
fn missing_own_address_keeps_no_node_from_starting() {
    run(async {
        // 192.0.2.0/24 is for documentation.
        let absent = Ipv4Addr::new(192, 0, 2, 1);
        let node = Node::start_with(1, |config| config.gncl.further = vec![absent]).await;
        let further = node.state.ctx.listens.further.get().expect("GNCL listens");
        assert_eq!(further.iter().map(|address| *address.ip()).collect::<Vec<_>>(), [absent]);
    });
}
