//! Values of class Stream by UDP: two real nodes, and a peer that is written by hand.

mod mate;

use std::{cell::RefCell, net::SocketAddr, sync::Arc, time::Duration};

use sinew_runtime::{
    tid::Tid,
    time::Time,
    wire::{Checksum, Class, Kind, Message},
};

use super::{
    bench::{ByHand, KIND, NINE, Node, introduction, next, pair, run, within},
    classes::of_class,
};
use crate::{
    access::Access,
    gncl::{
        LinkFact,
        core::{Introduction, Lane, write},
        datagrams::Announcement,
        inbound::Inbound,
        peer::frame,
    },
    outlet::LinkNumber,
};
use mate::{ACK, KEY, Mate, PROBE, VALUE, nines_app, opened};

fn value(node: &Node, to: Tid, number: u64) -> Message {
    of_class(Class::Stream, node.message(to, &number.to_le_bytes()))
}

fn send_value(node: &Node, to: Tid, number: u64) {
    node.stores.router.send(value(node, to, number)).expect("the peer is known");
}

#[test]
fn values_go_by_datagram_once_it_was_seen_that_they_get_through_and_both_nodes_count_them() {
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
            while a.stores.gncl.peer(b.address()).expect("it is there").left() > 0 {
                tokio::task::yield_now().await;
            }
        })
        .await;
        let position = a.stores.gncl.peer(b.address()).unwrap().channel().unwrap().position();
        assert_eq!((position.taken(), position.arrived), (200, 200), "{position:?}");
        within("all to be counted", async {
            loop {
                let arrived =
                    b.stores.gncl.peer(a.address()).unwrap().accounts()[Class::Stream as usize].arrived;
                assert_eq!(arrived.taken, 200);
                if arrived.handed_on == 200 {
                    break;
                }
                tokio::task::yield_now().await;
            }
        })
        .await;
    });
}

#[test]
fn values_stay_in_order_when_a_layer_is_restarted_at_either_side() {
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
fn a_value_is_repeated_until_it_is_acknowledged_and_one_that_is_superseded_is_not() {
    run(async {
        let mut node = Node::start(1).await;
        let mate = Mate::open_to(&mut node).await;
        send_value(&node, nines_app(), 1);
        let (first, payload) = mate.hear_value().await;
        assert_eq!(payload, 1_u64.to_le_bytes());
        assert_eq!(mate.hear_value().await, (first, payload), "again, with its number");
        send_value(&node, nines_app(), 2);
        let second = loop {
            let (number, payload) = mate.hear_value().await;
            if number != first {
                assert_eq!(payload, 2_u64.to_le_bytes());
                break number;
            }
        };
        assert!(second > first);
        assert_eq!(mate.hear_value().await.0, second, "the newest alone");
        mate.acknowledge(1, &[second]).await;
        within("the acknowledgement to be read", async {
            while node.stores.gncl.peer(NINE).expect("it is there").left() > 0 {
                tokio::task::yield_now().await;
            }
        })
        .await;
    });
}

#[test]
fn where_nothing_is_answered_any_more_the_last_value_goes_by_the_connection_with_its_number() {
    run(async {
        let mut node = Node::start(1).await;
        let mut mate = Mate::open_to(&mut node).await;
        send_value(&node, nines_app(), 1);
        let by_datagram = mate.hear_value().await;
        assert_eq!(mate.hear_on_connection().await, by_datagram);
        send_value(&node, nines_app(), 2);
        let (number, payload) = mate.hear_on_connection().await;
        assert_eq!(payload, 2_u64.to_le_bytes());
        assert!(number > by_datagram.0);
    });
}

#[test]
fn a_value_that_is_longer_than_a_datagram_goes_by_the_connection_and_so_does_all_before_an_answer() {
    run(async {
        let mut node = Node::start(1).await;
        let mut mate = Mate::linked_to(&mut node).await;
        send_value(&node, nines_app(), 1);
        let (first, _) = mate.hear_on_connection().await;
        assert!(first > 0);
        let probe = mate.hear().await;
        assert_eq!(probe.what, PROBE);
        mate.acknowledge_probe(&probe).await;
        // One that fills a datagram, and one of a byte more.
        let sized = |length: usize| of_class(Class::Stream, node.message(nines_app(), &vec![7; length]));
        let (second, payload) = loop {
            node.stores.router.send(sized(1_112)).expect("the peer is known");
            if let Ok(heard) = tokio::time::timeout(Duration::from_millis(1), mate.hear_value()).await {
                break heard;
            }
        };
        assert_eq!(payload.len(), 1_112);
        node.stores.router.send(sized(1_113)).expect("the peer is known");
        let (third, payload) = loop {
            let (number, payload) = mate.hear_on_connection().await;
            if payload.len() == 1_113 {
                break (number, payload);
            }
        };
        assert!(first < second && second < third, "{first} {second} {third}: {}", payload.len());
    });
}

#[test]
fn of_what_comes_twice_late_or_by_both_ways_each_newest_value_is_handed_on_once() {
    run(async {
        let mut node = Node::start(1).await;
        let mut inbox = node.app(1);
        let mut mate = Mate::open_to(&mut node).await;
        let to = node.tid(1);
        for number in [5, 5, 3, 9] {
            mate.send_value(to, number).await;
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
                // What came by datagram is read by now.
                for expected in [5_u64, 9] {
                    assert_eq!(next("a value", &mut inbox).await.payload[..], expected.to_le_bytes());
                }
            }
            mate.stream.say(&copy).await;
        }
        assert_eq!(next("a value", &mut inbox).await.payload[..], 10_u64.to_le_bytes());
        let acknowledged = loop {
            let heard = mate.hear().await;
            if heard.what & ACK != 0 && !heard.numbers.is_empty() {
                break heard.numbers;
            }
        };
        assert!(acknowledged.iter().any(|(first, _)| *first == 5), "{acknowledged:?}");
        within("all to be counted", async {
            loop {
                let arrived = node.stores.gncl.peer(NINE).unwrap().accounts()[Class::Stream as usize].arrived;
                assert!((arrived.taken, arrived.superseded) == (4, 1), "{arrived:?}");
                if arrived.handed_on == 3 {
                    break;
                }
                tokio::task::yield_now().await;
            }
        })
        .await;
    });
}

#[test]
fn bytes_of_strangers_and_what_is_malformed_are_dropped_and_counted_and_do_no_harm() {
    run(async {
        let mut node = Node::start(1).await;
        let mut inbox = node.app(1);
        let mate = Mate::open_to(&mut node).await;
        let good = mate.value_bytes(node.tid(1), 1, nines_app());
        mate.say_bytes(b"hello").await;
        node.counted("datagram of somebody else").await;
        mate.say_bytes(&mate.datagram(mate.key ^ 1, VALUE, &good)).await;
        node.counted("datagram with another key").await;
        let mut of_nobody = mate.datagram(mate.key, VALUE, &good);
        of_nobody[4..8].copy_from_slice(&12_u32.to_le_bytes());
        mate.say_bytes(&of_nobody).await;
        node.counted("datagram of a stranger").await;
        for length in 0..good.len() {
            mate.say(VALUE, &good[..length]).await;
        }
        let mut damaged = good.clone();
        *damaged.last_mut().expect("it has a payload") ^= 1;
        mate.say(VALUE, &damaged).await;
        mate.say(0xff, &good).await;
        mate.say(ACK, &[0xff; 100]).await;
        mate.say(VALUE, &[0; 3_000]).await;
        node.counted("datagram malformed").await;
        // A source that is not the peer's, and a class that is none of a value.
        let forged = mate.value_bytes(node.tid(1), 2, node.tid(7));
        mate.say(VALUE, &forged).await;
        node.counted("forged source").await;
        mate.send_value(node.tid(1), 3).await;
        assert_eq!(next("a value", &mut inbox).await.payload[..], 3_u64.to_le_bytes());
        assert_eq!(node.stores.gncl.refusals.of("datagram with another key"), 1);
    });
}

#[test]
fn a_value_in_somebody_elses_name_is_neither_acknowledged_nor_a_flow_of_the_peer() {
    run(async {
        let mut node = Node::start(1).await;
        let mate = Mate::open_to(&mut node).await;
        let peer = node.stores.gncl.peer(NINE).expect("it is linked");
        let forged = mate.value_bytes(node.tid(1), 2, node.tid(7));
        mate.say(VALUE, &forged).await;
        node.counted("forged source").await;
        mate.say(PROBE, &77_u64.to_le_bytes()).await;
        let answer = loop {
            let heard = mate.hear().await;
            if heard.what & ACK != 0 {
                break heard;
            }
        };
        assert_eq!(answer.numbers, [(77, 0)], "the probe alone");
        let arrived = peer.accounts()[Class::Stream as usize].arrived;
        assert_eq!((arrived.taken, arrived.refused), (0, 0), "{arrived:?}");
    });
}

#[test]
fn a_value_that_the_access_list_does_not_allow_is_refused_whichever_way_it_comes() {
    run(async {
        let mut node = Node::start(1).await;
        let rules = "[[rule]]\nfrom = ['*']\nto = ['*']\nclasses = ['control']\n";
        let access = Access::in_test(&node.stores, rules);
        let mate = Mate::open_to(&mut node).await;
        let mut inbox = node.app(1);
        mate.send_value(node.tid(1), 1).await;
        within("it to be refused", async {
            while node.stores.refusals.of("access list") == 0 {
                tokio::task::yield_now().await;
            }
        })
        .await;
        access.replace_in_test("[[rule]]\nfrom = ['0.0.0.9']\nto = ['*']\nclasses = ['stream']\n");
        mate.send_value(node.tid(1), 2).await;
        assert_eq!(next("what is allowed", &mut inbox).await.payload[..], 2_u64.to_le_bytes());
    });
}

#[test]
fn nothing_of_a_peer_that_is_lost_is_handed_on_and_nothing_with_its_former_key() {
    run(async {
        let mut node = Node::start(1).await;
        let mut inbox = node.app(1);
        let mate = Mate::open_to(&mut node).await;
        mate.send_value(node.tid(1), 1).await;
        next("a value", &mut inbox).await;
        // NDL tells of it, and that it is lost.
        node.find(NINE, SocketAddr::from(([127, 0, 0, 1], 1)));
        node.lose(NINE);
        node.broken().await;
        mate.send_value(node.tid(1), 2).await;
        node.counted("datagram of a stranger").await;
        drop(mate);
        // It has not lost us, and dials again: nothing of it comes between its loss and its finding. spec: GNCL-7
        let mut again = ByHand::dial(&node).await;
        let hello = Introduction { dial: 4, ..introduction(node.address()) };
        again.say(&frame(NINE, node.address(), Kind::GNCL_HELLO, write(&hello))).await;
        let refusal = again.refusal().await;
        assert_eq!(refusal.cause, "contested", "{}", refusal.sentence);
        assert!(node.stores.gncl.peer(NINE).is_none());
        node.find(NINE, SocketAddr::from(([127, 0, 0, 1], 1)));
        node.fact_that(|fact| matches!(fact, LinkFact::DialRefused { .. })).await;
        let next_life = Mate::dialling(&mut node, 5).await.open(&node).await;
        let former = next_life.datagram(0, VALUE, &next_life.value_bytes(node.tid(1), 3, nines_app()));
        next_life.say_bytes(&former).await;
        node.counted("datagram with another key").await;
        // It has no acknowledgement, perhaps, and sends again what came before: that comes once.
        next_life.send_value(node.tid(1), 1).await;
        next_life.send_value(node.tid(1), 4).await;
        assert_eq!(next("a value", &mut inbox).await.payload[..], 4_u64.to_le_bytes());
    });
}

// spec: DATAGRAM-2
#[test]
fn a_peer_that_has_forgotten_what_came_gets_the_last_value_and_what_was_under_way_is_unknown() {
    run(async {
        let mut node = Node::start(1).await;
        let mut mate = Mate::open_to(&mut node).await;
        send_value(&node, nines_app(), 1);
        let last = mate.hear_value().await;
        mate.announce(&node, KEY + 1).await;
        assert_eq!(mate.hear_on_connection().await, last);
        let sent = node.stores.gncl.peer(NINE).expect("it is there").accounts()[Class::Stream as usize].sent;
        assert_eq!((sent.taken, sent.unknown), (2, 1), "{sent:?}");
    });
}

#[test]
fn what_a_former_connection_says_of_datagrams_is_old_news() {
    run(async {
        let mut node = Node::start(1).await;
        let _mate = Mate::open_to(&mut node).await;
        let peer = node.stores.gncl.peer(NINE).expect("it is linked");
        let say_on = |lane, link| {
            let (stores, peer) = (node.stores.clone(), peer.clone());
            let (spin, checksum, outcomes) = (Arc::default(), Checksum::Crc, RefCell::default());
            let inbound = Inbound { stores, peer, spin, lane, link, checksum, outcomes };
            let said = Announcement { port: 1, key: KEY, address: 0 };
            inbound.receive(Time::now(), frame(NINE, node.address(), Kind::GNCL_DATAGRAMS, write(&said)))
        };
        assert_eq!(say_on(Lane::Stream, LinkNumber::default()), Ok(()));
        assert!(peer.channel().expect("both can").is_open(), "nothing goes elsewhere");
        assert!(say_on(Lane::Control, LinkNumber::default()).is_err());
    });
}

#[test]
fn a_value_of_a_life_that_is_over_is_neither_acknowledged_nor_counted_as_taken() {
    run(async {
        let mut node = Node::start(1).await;
        let mate = Mate::open_to(&mut node).await;
        let peer = node.stores.gncl.peer(NINE).expect("it is linked");
        node.stores.gncl.fence(NINE, peer.incarnation);
        mate.send_value(node.tid(1), 5).await;
        node.counted("datagram of a life that is over").await;
        mate.say(PROBE, &77_u64.to_le_bytes()).await;
        let answer = loop {
            let heard = mate.hear().await;
            if heard.what & ACK != 0 {
                break heard;
            }
        };
        assert_eq!(answer.numbers, [(77, 0)], "the probe alone");
        let arrived = peer.accounts()[Class::Stream as usize].arrived;
        assert_eq!((arrived.taken, arrived.waiting), (0, 0), "{arrived:?}");
    });
}

#[test]
fn a_node_that_is_not_to_use_datagrams_says_nothing_of_them() {
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
            assert!(node.stores.gncl.peer(peer.address()).expect("linked").channel().is_none());
        }
    });
}

#[test]
fn what_is_under_way_when_a_node_is_stopped_is_handed_over_before_its_goodbye() {
    run(async {
        let mut node = Node::start(1).await;
        let mut mate = Mate::open_to(&mut node).await;
        send_value(&node, nines_app(), 1);
        let by_datagram = mate.hear_value().await;
        node.leave();
        assert_eq!(mate.hear_on_connection().await, by_datagram);
        loop {
            if mate.stream.hear().await.header.kind == Kind::GNCL_GOODBYE {
                break;
            }
        }
    });
}
