//! Values of class Stream by UDP: two real nodes, and a handwritten peer.

mod by_hand;

use std::{
    cell::{Cell, RefCell},
    net::SocketAddr,
    sync::Arc,
    time::Duration,
};

use by_hand::{ACK, DatagramPeer, KEY, PROBE, VALUE, nines_app, opened};
use sinew_model::facts::LinkFact;
use sinew_runtime::{
    tid::Tid,
    time::Time,
    wire::{Checksum, Class, Kind, Message},
};
use sinew_session::outlet::LinkNumber;

use super::{
    bench::{ByHand, KIND, NINE, Node, introduction, next, pair, run, within},
    classes::of_class,
};
use crate::{
    core::{Introduction, Lane, write},
    datagrams::Announcement,
    frame::frame,
    inbound::Inbound,
};

fn value(node: &Node, to: Tid, number: u64) -> Message {
    of_class(Class::Stream, node.message(to, &number.to_le_bytes()))
}

fn send_value(node: &Node, to: Tid, number: u64) {
    node.state.ctx.router.send(value(node, to, number)).expect("the peer is known");
}

#[test]
fn values_use_datagrams_after_a_successful_probe() {
    run(async {
        let (a, b) = pair().await;
        let mut inbox = b.app(1);
        opened(&a, b.address()).await;
        for number in 0..200 {
            send_value(&a, b.tid(1), number);
            let message = next("a value", &mut inbox).await;
            assert_eq!(message.payload[..], number.to_le_bytes());
            assert_eq!((message.header.correlation, message.header.class), (0, Class::Stream));
        }
        within("all to be acknowledged", async {
            while a.state.store.peer(b.address()).expect("it is there").left() > 0 {
                tokio::task::yield_now().await;
            }
        })
        .await;
        let position = a.state.store.peer(b.address()).unwrap().channel().unwrap().position();
        assert_eq!((position.taken(), position.arrived), (200, 200), "{position:?}");
        within("all to be counted", async {
            loop {
                let arrived =
                    b.state.store.peer(a.address()).unwrap().accounts()[Class::Stream as usize].arrived;
                assert_eq!(arrived.taken, 200);
                if arrived.forwarded == 200 {
                    break;
                }
                tokio::task::yield_now().await;
            }
        })
        .await;
    });
}

#[test]
fn values_stay_in_order_over_layer_restarts() {
    run(async {
        let (mut a, mut b) = pair().await;
        let mut inbox = b.app(1);
        opened(&a, b.address()).await;
        let (mut sent, mut last) = (0, 0);
        for round in 0..6 {
            for _ in 0..50 {
                sent += 1;
                send_value(&a, b.tid(1), sent);
            }
            let layer = if round % 2 == 0 { &mut a } else { &mut b };
            layer.stop_layer();
            sent += 1;
            send_value(&a, b.tid(1), sent);
            let layer = if round % 2 == 0 { &mut a } else { &mut b };
            layer.start_layer().await;
            while last < sent {
                let message = next("a value", &mut inbox).await;
                let number = u64::from_le_bytes(message.payload[..].try_into().expect("a number"));
                assert!(number > last, "{number} came after {last}");
                last = number;
            }
        }
    });
}

#[test]
fn value_is_repeated_until_acknowledged_unless_superseded() {
    run(async {
        let mut node = Node::start(1).await;
        let remote = DatagramPeer::open_to(&mut node).await;
        send_value(&node, nines_app(), 1);
        let (first, payload) = remote.receive_value().await;
        assert_eq!(payload, 1_u64.to_le_bytes());
        assert_eq!(remote.receive_value().await, (first, payload), "again, with its number");
        send_value(&node, nines_app(), 2);
        let second = loop {
            let (number, payload) = remote.receive_value().await;
            if number != first {
                assert_eq!(payload, 2_u64.to_le_bytes());
                break number;
            }
        };
        assert!(second > first);
        assert_eq!(remote.receive_value().await.0, second, "the newest alone");
        remote.acknowledge(1, &[second]).await;
        within("the acknowledgement to be read", async {
            while node.state.store.peer(NINE).expect("it is there").left() > 0 {
                tokio::task::yield_now().await;
            }
        })
        .await;
    });
}

#[test]
fn without_answers_the_last_value_uses_the_connection() {
    run(async {
        let mut node = Node::start(1).await;
        let mut remote = DatagramPeer::open_to(&mut node).await;
        send_value(&node, nines_app(), 1);
        let by_datagram = remote.receive_value().await;
        assert_eq!(remote.receive_on_connection().await, by_datagram);
        send_value(&node, nines_app(), 2);
        let (number, payload) = remote.receive_on_connection().await;
        assert_eq!(payload, 2_u64.to_le_bytes());
        assert!(number > by_datagram.0);
    });
}

#[test]
fn too_long_or_early_values_use_the_connection() {
    run(async {
        let mut node = Node::start(1).await;
        let mut remote = DatagramPeer::linked_to(&mut node).await;
        send_value(&node, nines_app(), 1);
        let (first, _) = remote.receive_on_connection().await;
        assert!(first > 0);
        let probe = remote.receive().await;
        assert_eq!(probe.what, PROBE);
        remote.acknowledge_probe(&probe).await;
        // One that fills a datagram, and one with one byte more.
        let sized = |length: usize| of_class(Class::Stream, node.message(nines_app(), &vec![7; length]));
        let (second, payload) = loop {
            node.state.ctx.router.send(sized(1_112)).expect("the peer is known");
            if let Ok(received) = tokio::time::timeout(Duration::from_millis(1), remote.receive_value()).await
            {
                break received;
            }
        };
        assert_eq!(payload.len(), 1_112);
        node.state.ctx.router.send(sized(1_113)).expect("the peer is known");
        let (third, payload) = loop {
            let (number, payload) = remote.receive_on_connection().await;
            if payload.len() == 1_113 {
                break (number, payload);
            }
        };
        assert!(first < second && second < third, "{first} {second} {third}: {}", payload.len());
    });
}

#[test]
fn duplicated_and_late_values_are_forwarded_once_in_order() {
    run(async {
        let mut node = Node::start(1).await;
        let mut inbox = node.app(1);
        let mut remote = DatagramPeer::open_to(&mut node).await;
        let to = node.tid(1);
        for number in [5, 5, 3, 9] {
            remote.send_value(to, number).await;
        }
        let mut by_connection = Message::new(
            sinew_runtime::wire::Header::new(KIND, nines_app(), to),
            bytes::Bytes::copy_from_slice(&8_u64.to_le_bytes()),
        );
        for number in [8_u64, 10] {
            (by_connection.header.class, by_connection.header.correlation) = (Class::Stream, number);
            by_connection.header.sent = Time::now();
            let payload = bytes::Bytes::copy_from_slice(&number.to_le_bytes());
            let copy = Message::new(by_connection.header, payload);
            if number == 8 {
                // All datagrams are read by now.
                for expected in [5_u64, 9] {
                    assert_eq!(next("a value", &mut inbox).await.payload[..], expected.to_le_bytes());
                }
            }
            remote.stream.send(&copy).await;
        }
        assert_eq!(next("a value", &mut inbox).await.payload[..], 10_u64.to_le_bytes());
        let acknowledged = loop {
            let received = remote.receive().await;
            if received.what & ACK != 0 && !received.numbers.is_empty() {
                break received.numbers;
            }
        };
        assert!(acknowledged.iter().any(|(first, _)| *first == 5), "{acknowledged:?}");
        within("all to be counted", async {
            loop {
                let arrived = node.state.store.peer(NINE).unwrap().accounts()[Class::Stream as usize].arrived;
                assert!((arrived.taken, arrived.superseded) == (4, 1), "{arrived:?}");
                if arrived.forwarded == 3 {
                    break;
                }
                tokio::task::yield_now().await;
            }
        })
        .await;
    });
}

#[test]
fn foreign_and_malformed_bytes_are_dropped_and_counted() {
    run(async {
        let mut node = Node::start(1).await;
        let mut inbox = node.app(1);
        let remote = DatagramPeer::open_to(&mut node).await;
        let good = remote.value_bytes(node.tid(1), 1, nines_app());
        remote.send_bytes(b"hello").await;
        node.counted("datagram of somebody else").await;
        remote.send_bytes(&remote.datagram(remote.key ^ 1, VALUE, &good)).await;
        node.counted("datagram with another key").await;
        let mut of_nobody = remote.datagram(remote.key, VALUE, &good);
        of_nobody[4..8].copy_from_slice(&12_u32.to_le_bytes());
        remote.send_bytes(&of_nobody).await;
        node.counted("datagram of a stranger").await;
        for length in 0..good.len() {
            remote.send(VALUE, &good[..length]).await;
        }
        let mut damaged = good.clone();
        *damaged.last_mut().expect("it has a payload") ^= 1;
        remote.send(VALUE, &damaged).await;
        remote.send(0xff, &good).await;
        remote.send(ACK, &[0xff; 100]).await;
        remote.send(VALUE, &[0; 3_000]).await;
        node.counted("datagram malformed").await;
        // A source that is not the peer's, and a class that is not Stream.
        let forged = remote.value_bytes(node.tid(1), 2, node.tid(7));
        remote.send(VALUE, &forged).await;
        node.counted("forged source").await;
        remote.send_value(node.tid(1), 3).await;
        assert_eq!(next("a value", &mut inbox).await.payload[..], 3_u64.to_le_bytes());
        assert_eq!(node.state.store.refusals.of("datagram with another key"), 1);
    });
}

#[test]
fn value_with_a_forged_source_is_not_acknowledged() {
    run(async {
        let mut node = Node::start(1).await;
        let remote = DatagramPeer::open_to(&mut node).await;
        let peer = node.state.store.peer(NINE).expect("it is linked");
        let forged = remote.value_bytes(node.tid(1), 2, node.tid(7));
        remote.send(VALUE, &forged).await;
        node.counted("forged source").await;
        remote.send(PROBE, &77_u64.to_le_bytes()).await;
        let answer = loop {
            let received = remote.receive().await;
            if received.what & ACK != 0 {
                break received;
            }
        };
        assert_eq!(answer.numbers, [(77, 0)], "the probe alone");
        let arrived = peer.accounts()[Class::Stream as usize].arrived;
        assert_eq!((arrived.taken, arrived.refused), (0, 0), "{arrived:?}");
    });
}

#[test]
fn disallowed_value_is_rejected_by_either_transport() {
    run(async {
        let mut node = Node::start(1).await;
        let rules = "[[rule]]\nfrom = ['*']\nto = ['*']\nclasses = ['control']\n";
        let access = node.state.security.access_in_test(&node.state.ctx, rules);
        let remote = DatagramPeer::open_to(&mut node).await;
        let mut inbox = node.app(1);
        remote.send_value(node.tid(1), 1).await;
        within("it to be refused", async {
            while node.state.ctx.refusals.of("access list") == 0 {
                tokio::task::yield_now().await;
            }
        })
        .await;
        access.replace_in_test("[[rule]]\nfrom = ['0.0.0.9']\nto = ['*']\nclasses = ['stream']\n");
        remote.send_value(node.tid(1), 2).await;
        assert_eq!(next("what is allowed", &mut inbox).await.payload[..], 2_u64.to_le_bytes());
    });
}

#[test]
fn values_of_a_lost_peer_are_dropped() {
    run(async {
        let mut node = Node::start(1).await;
        let mut inbox = node.app(1);
        let remote = DatagramPeer::open_to(&mut node).await;
        remote.send_value(node.tid(1), 1).await;
        next("a value", &mut inbox).await;
        // NDL reports it as found, and as lost.
        node.find(NINE, SocketAddr::from(([127, 0, 0, 1], 1)));
        node.lose(NINE);
        node.broken().await;
        remote.send_value(node.tid(1), 2).await;
        node.counted("datagram of a stranger").await;
        drop(remote);
        // It has not lost us, and dials again: nothing of it is accepted between its loss and its finding. spec: GNCL-7
        let mut again = ByHand::dial(&node).await;
        let hello = Introduction { dial: 4, ..introduction(node.address()) };
        again.send(&frame(NINE, node.address(), Kind::GNCL_HELLO, write(&hello))).await;
        let refusal = again.refusal().await;
        assert_eq!(refusal.cause, "contested", "{}", refusal.sentence);
        assert!(node.state.store.peer(NINE).is_none());
        node.find(NINE, SocketAddr::from(([127, 0, 0, 1], 1)));
        node.fact_that(|fact| matches!(fact, LinkFact::DialRefused { .. })).await;
        let next_life = DatagramPeer::dialling(&mut node, 5).await.open(&node).await;
        let former = next_life.datagram(0, VALUE, &next_life.value_bytes(node.tid(1), 3, nines_app()));
        next_life.send_bytes(&former).await;
        node.counted("datagram with another key").await;
        // It may have no acknowledgement, and sends the earlier values again: each is delivered once.
        next_life.send_value(node.tid(1), 1).await;
        next_life.send_value(node.tid(1), 4).await;
        assert_eq!(next("a value", &mut inbox).await.payload[..], 4_u64.to_le_bytes());
    });
}

// spec: DATAGRAM-2
#[test]
fn forgetful_peer_gets_the_last_value() {
    run(async {
        let mut node = Node::start(1).await;
        let mut remote = DatagramPeer::open_to(&mut node).await;
        send_value(&node, nines_app(), 1);
        let last = remote.receive_value().await;
        remote.announce(&node, KEY + 1).await;
        assert_eq!(remote.receive_on_connection().await, last);
        let sent = node.state.store.peer(NINE).expect("it is there").accounts()[Class::Stream as usize].sent;
        assert_eq!((sent.taken, sent.unknown), (2, 1), "{sent:?}");
    });
}

#[test]
fn datagram_state_of_a_former_connection_is_ignored() {
    run(async {
        let mut node = Node::start(1).await;
        let _mate = DatagramPeer::open_to(&mut node).await;
        let peer = node.state.store.peer(NINE).expect("it is linked");
        let say_on = |lane, link| {
            let (state, peer) = (node.state.clone(), peer.clone());
            let (spin, checksum, outcomes) = (Arc::default(), Checksum::Crc, RefCell::default());
            let (conversion, former) = (Cell::default(), Cell::default());
            let inbound = Inbound { state, peer, spin, lane, link, checksum, outcomes, conversion, former };
            let said = Announcement { port: 1, key: KEY, address: 0 };
            inbound.receive(Time::now(), frame(NINE, node.address(), Kind::GNCL_DATAGRAMS, write(&said)))
        };
        assert_eq!(say_on(Lane::Stream, LinkNumber::default()), Ok(()));
        assert!(peer.channel().expect("both can").is_open(), "nothing goes elsewhere");
        assert!(say_on(Lane::Control, LinkNumber::default()).is_err());
    });
}

#[test]
fn value_of_an_ended_incarnation_is_not_acknowledged() {
    run(async {
        let mut node = Node::start(1).await;
        let remote = DatagramPeer::open_to(&mut node).await;
        let peer = node.state.store.peer(NINE).expect("it is linked");
        node.state.store.fence(NINE, peer.incarnation);
        remote.send_value(node.tid(1), 5).await;
        node.counted("datagram of a former incarnation").await;
        remote.send(PROBE, &77_u64.to_le_bytes()).await;
        let answer = loop {
            let received = remote.receive().await;
            if received.what & ACK != 0 {
                break received;
            }
        };
        assert_eq!(answer.numbers, [(77, 0)], "the probe alone");
        let arrived = peer.accounts()[Class::Stream as usize].arrived;
        assert_eq!((arrived.taken, arrived.waiting), (0, 0), "{arrived:?}");
    });
}

#[test]
fn node_without_datagrams_does_not_announce_them() {
    run(async {
        let (mut a, mut b) =
            (Node::start_with(1, |config| config.gncl.datagrams = false).await, Node::start(2).await);
        a.find(b.address(), b.listens_at());
        a.up().await;
        b.up().await;
        let mut inbox = b.app(1);
        send_value(&a, b.tid(1), 1);
        assert_eq!(next("a value", &mut inbox).await.payload[..], 1_u64.to_le_bytes());
        for (node, peer) in [(&a, &b), (&b, &a)] {
            assert!(node.state.store.peer(peer.address()).expect("linked").channel().is_none());
        }
    });
}

#[test]
fn values_in_flight_are_handed_over_before_the_goodbye() {
    run(async {
        let mut node = Node::start(1).await;
        let mut remote = DatagramPeer::open_to(&mut node).await;
        send_value(&node, nines_app(), 1);
        let by_datagram = remote.receive_value().await;
        node.leave();
        assert_eq!(remote.receive_on_connection().await, by_datagram);
        loop {
            if remote.stream.receive().await.header.kind == Kind::GNCL_GOODBYE {
                break;
            }
        }
    });
}
