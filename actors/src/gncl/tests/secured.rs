//! Nodes that prove who they are, and what those are told that do not.

use std::{sync::Arc, time::Duration};

use bytes::Bytes;
use sinew_runtime::{
    app::{Heir, LastWill, Will},
    outcome::Outcome,
    tid::{Incarnation, NodeAddress},
    wire::{Class, Kind},
};
use tokio::net::TcpListener;

use super::bench::{ByHand, Cable, NINE, Node, introduction, next, pair, run, within};
use crate::{
    config::NodeConfig,
    gncl::{Event, LinkFact, core::write, peer::frame, secure::is_sealed},
    ndl::{LossReason, MembershipFact},
    secured::Secured,
    security::{
        DenyList, Identity,
        tests::ground::{self, Authority},
    },
    stores::Stores,
    wills,
};

impl Node {
    /// One that has keys of this project, made for a node of this number.
    async fn start_secured(number: u32, keys: &Authority, made_for: u32) -> Self {
        Self::start_secured_with(number, keys, made_for, |_| {}).await
    }

    async fn start_secured_with(
        number: u32,
        keys: &Authority,
        made_for: u32,
        set: impl FnOnce(&mut NodeConfig),
    ) -> Self {
        Self::start_secured_in(Incarnation(1), number, (keys, made_for), set).await
    }

    /// The same in that life.
    async fn start_secured_in(
        life: Incarnation,
        number: u32,
        (keys, made_for): (&Authority, u32),
        set: impl FnOnce(&mut NodeConfig),
    ) -> Self {
        Self::begin(secured_stores(life, number, (keys, made_for), set)).await
    }
}

/// The stores of such a node.
pub(super) fn secured_stores(
    life: Incarnation,
    number: u32,
    (keys, made_for): (&Authority, u32),
    set: impl FnOnce(&mut NodeConfig),
) -> Arc<Stores> {
    let mut config = NodeConfig::new(format!("node-{number}"));
    config.address = Some(NodeAddress::new(number));
    set(&mut config);
    let (project, name) = (config.project.clone(), format!("node-{made_for}"));
    let made_for = Identity { project, address: NodeAddress::new(made_for), name };
    let stores = Stores::for_test(config, life);
    let credentials = keys.credentials_of(&made_for);
    let secured = Secured::new(ground::tls(&credentials), &credentials, 8, life);
    assert!(stores.secured.set(secured).is_ok(), "it is set once");
    stores
}

/// As the name of its test nodes' project.
pub(super) fn keys() -> Authority {
    Authority::new("sinew")
}

/// Two nodes with keys of one project, the second of which is reached over a cable.
async fn two(keys: &Authority) -> (Node, Node, Cable) {
    let mut a = Node::start_secured(1, keys, 1).await;
    let b = Node::start_secured(2, keys, 2).await;
    let cable = Cable::to(b.listens_at()).await;
    a.find(b.address(), cable.address);
    a.up().await;
    (a, b, cable)
}

#[test]
fn messages_of_each_class_and_length_pass_both_ways_between_nodes_that_have_proven_who_they_are() {
    run(async {
        let (mut a, b, _cable) = two(&keys()).await;
        let (mut at_a, mut at_b) = (a.app(1), b.app(1));
        for class in [Class::Control, Class::Stream, Class::Bulk] {
            for length in [0, 8, 1_000, 16_384, 16_385, 65_536, 1_000_000] {
                let payload: Vec<u8> = (0..length).map(|at| (at % 251) as u8).collect();
                for (from, to, inbox) in [(&a, b.tid(1), &mut at_b), (&b, a.tid(1), &mut at_a)] {
                    let mut message = from.message(to, &payload);
                    message.header.class = class;
                    from.stores.router.send(message).expect("somebody takes it");
                    assert_eq!(next("a message", inbox).await.payload, payload, "{class:?}");
                }
            }
        }
        a.stores.router.send(a.confirmed(b.tid(1), 7)).expect("there is room for it");
        next("a message", &mut at_b).await.receipt.expect("it is to be confirmed").settle(Outcome::Delivered);
        assert_eq!(next("an outcome", &mut a.settled).await, (7, Outcome::Delivered));
    });
}

#[test]
fn a_flood_that_fills_the_socket_arrives_whole_and_in_order() {
    run(async {
        let (a, b, _cable) = two(&keys()).await;
        let mut at_b = b.app(1);
        for number in 0..500_u32 {
            let mut payload = vec![0; 20_000 + number as usize];
            payload[..4].copy_from_slice(&number.to_le_bytes());
            let mut message = a.message(b.tid(1), &payload);
            message.header.class = Class::Bulk;
            a.stores.router.send(message).expect("there is room for it");
        }
        for number in 0..500_u32 {
            let message = next("a message", &mut at_b).await;
            assert_eq!(message.payload[..4], number.to_le_bytes());
            assert_eq!(message.payload.len(), 20_000 + number as usize);
        }
    });
}

#[test]
fn cuts_in_full_flow_lose_double_and_reorder_nothing() {
    run(async {
        let (a, b, cable) = two(&keys()).await;
        let mut at_b = b.app(1);
        let mut there = 0u64;
        for round in 1..=20u64 {
            for _ in 0..50 {
                there += 1;
                a.send(b.tid(1), &there.to_le_bytes());
            }
            if round % 2 == 0 {
                cable.cut();
            }
            for number in there - 49..=there {
                assert_eq!(next("a message", &mut at_b).await.payload[..], number.to_le_bytes());
            }
        }
    });
}

#[test]
fn nodes_with_keys_of_two_projects_refuse_each_other_and_both_know_why() {
    run(async {
        let a = Node::start_secured(1, &keys(), 1).await;
        let b = Node::start_secured(2, &keys(), 2).await;
        a.find(b.address(), b.listens_at());
        b.counted("peer not proven").await;
        a.counted("peer not proven").await;
    });
}

#[test]
fn who_has_another_nodes_keys_is_not_taken_for_that_node_nor_for_itself() {
    run(async {
        let keys = keys();
        let a = Node::start_secured(1, &keys, 1).await;
        let thief = Node::start_secured(3, &keys, 2).await;
        thief.find(a.address(), a.listens_at());
        a.counted("security").await;
        thief.counted("refused by the peer").await;
        a.find(thief.address(), thief.listens_at());
        within("the thief's WELCOME to be refused", async {
            while a.stores.gncl.refusals.of("security") < 2 {
                tokio::task::yield_now().await;
            }
        })
        .await;
    });
}

// spec: GNCL-18
#[test]
fn a_node_whose_certificate_is_revoked_is_refused_on_the_link_that_stands_and_on_the_next_one() {
    run(async {
        let (mut a, b, _cable) = two(&keys()).await;
        let mut at_a = a.app(1);
        b.send(a.tid(1), b"before");
        next("a message", &mut at_a).await;
        // When
        revoke(&a, &b);
        a.tell(Event::DenyListChanged);
        // Then: it ends with words
        a.broken().await;
        a.counted("security").await;
        b.counted("refused by the peer").await;
        // And as NDL still holds it for present it is dialled, and not taken.
        a.counted("peer not proven").await;
    });
}

// spec: WILL-5
#[test]
fn the_wills_of_a_node_whose_certificate_is_revoked_are_held_no_more_and_not_taken() {
    run(async {
        let (mut a, b, _cable) = two(&keys()).await;
        let (node, incarnation) = (b.address(), Incarnation(1));
        let mut heir = a.app(1);
        let will = will_for_app_1_of(&a);
        let says = wills::tests::said(incarnation, b.tid(1).app, &will);
        wills::receive(&a.stores, node, &says).expect("a legal one");
        // Those of a life that is still to come would outlive it.
        let of_the_next = wills::tests::said(Incarnation(2), b.tid(1).app, &will);
        assert!(wills::receive(&a.stores, node, &of_the_next).is_err(), "it is another life that is linked");
        // When: it is revoked, says it again all the same, and is lost
        revoke(&a, &b);
        a.tell(Event::DenyListChanged);
        a.broken().await;
        wills::receive(&a.stores, node, &says).expect("a legal one");
        wills::feed(&a.stores, wills::Input::NodeLost { node, incarnation });
        wills::feed(&a.stores, wills::Input::LinkUp { node, incarnation: Incarnation(9) });
        // Then: what comes next is not its
        a.send(a.tid(1), b"afterwards");
        assert_eq!(next("a message", &mut heir).await.payload[..], *b"afterwards");
    });
}

fn will_for_app_1_of(node: &Node) -> Will {
    Will {
        heir: Heir::Tid(node.tid(1)),
        kind: Kind::named("stop"),
        class: Class::Control,
        payload: Bytes::new(),
        when: LastWill::OnDeath,
    }
}

// spec: WILL-6
#[test]
fn wills_of_another_life_than_the_linked_one_are_not_taken_where_nobody_has_keys_either() {
    run(async {
        let (a, b) = pair().await;
        let (mut heir, will) = (a.app(1), will_for_app_1_of(&a));
        let says = |life| wills::tests::said(Incarnation(life), b.tid(1).app, &will);
        wills::receive(&a.stores, b.address(), &says(1)).expect("of the life that is linked");
        // When: on one link lists come of ever later lives
        for life in 2..10 {
            assert!(wills::receive(&a.stores, b.address(), &says(life)).is_err(), "of another life: {life}");
        }
        // Then: none was executed
        a.send(a.tid(1), b"afterwards");
        assert_eq!(next("a message", &mut heir).await.payload[..], *b"afterwards");
    });
}

/// Nothing looks at what there is until GNCL is told.
fn revoke(at: &Node, whose: &Node) {
    let revoked = &whose.stores.secured.get().expect("it has keys").serial;
    let list = DenyList::read(&revoked.to_string()).expect("it is a number");
    at.stores.secured.get().expect("it has keys").tls.deny(list);
}

/// A node that a thief was linked with, as node 2 in the last of all lives; its keys are on that node's deny list, which GNCL does not know.
async fn left_by_a_thief(keys: &Authority) -> Node {
    let mut a = Node::start_secured(1, keys, 1).await;
    let thief = Node::start_secured_in(Incarnation(u64::MAX), 2, (keys, 2), |_| {}).await;
    thief.find(a.address(), a.listens_at());
    a.up().await;
    revoke(&a, &thief);
    drop(thief);
    a.broken().await;
    a
}

/// Node 2 itself, with new keys and in an earlier life, is linked with `a`: after 5 s.
async fn itself_comes(mut a: Node, keys: &Authority) {
    let b = Node::start_secured(2, keys, 2).await;
    b.find(a.address(), a.listens_at());
    a.counted("stale incarnation").await;
    let LinkFact::LinkUp { incarnation, .. } = a.fact().await else { panic!("no other fact") };
    assert_eq!(incarnation, Incarnation(1));
}

// spec: GNCL-7
#[test]
fn a_thief_who_hangs_up_before_its_certificate_is_revoked_does_not_keep_the_node_itself_out() {
    run(async {
        let keys = keys();
        let a = left_by_a_thief(&keys).await;
        a.tell(Event::DenyListChanged);
        itself_comes(a, &keys).await;
    });
}

// spec: GNCL-7
#[test]
fn a_thief_whose_certificate_is_revoked_does_not_keep_the_node_itself_out_when_gncl_is_restarted() {
    run(async {
        let keys = keys();
        let mut a = left_by_a_thief(&keys).await;
        a.stop_layer();
        a.start_layer().await;
        itself_comes(a, &keys).await;
    });
}

// spec: GNCL-7
#[test]
fn a_thief_that_was_lost_before_gncl_was_restarted_does_not_keep_the_node_itself_out_either() {
    run(async {
        let keys = keys();
        let mut a = left_by_a_thief(&keys).await;
        a.stop_layer();
        // What that instance knew is gone.
        a.stores.gncl.forget(NodeAddress::new(2));
        a.start_layer().await;
        let (node, incarnation) = (NodeAddress::new(2), Incarnation(u64::MAX));
        let lost = MembershipFact::NodeLost { node, incarnation, why: LossReason::Crashed };
        a.tell(Event::Membership(lost));
        itself_comes(a, &keys).await;
    });
}

#[test]
fn a_node_without_keys_is_told_so_whoever_dials() {
    run(async {
        let secured = Node::start_secured(1, &keys(), 1).await;
        let open = Node::start(2).await;
        open.find(secured.address(), secured.listens_at());
        secured.counted("security").await;
        open.counted("refused by the peer").await;
        let dials = Node::start_secured(3, &keys(), 3).await;
        dials.find(open.address(), open.listens_at());
        open.counted("security").await;
        dials.counted("peer not proven").await;
    });
}

#[test]
fn a_stranger_reads_in_plain_words_that_it_must_prove_who_it_is() {
    run(async {
        let secured = Node::start_secured(1, &keys(), 1).await;
        let mut stranger = ByHand::dial(&secured).await;
        let hello = introduction(secured.address());
        stranger.say(&frame(NINE, secured.address(), Kind::GNCL_HELLO, write(&hello))).await;
        let refusal = stranger.refusal().await;
        assert_eq!(refusal.cause, "security");
        assert!(refusal.sentence.contains("sinew keys issue"), "{}", refusal.sentence);
    });
}

#[test]
fn a_secured_node_says_nothing_to_whom_it_dials_before_that_one_has_proven_who_it_is() {
    run(async {
        let secured = Node::start_secured(1, &keys(), 1).await;
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        secured.find(NINE, listener.local_addr().unwrap());
        let (mut socket, _) = within("the node's dial", listener.accept()).await.unwrap();
        let mut said = [0; 4_096];
        let reading = tokio::io::AsyncReadExt::read(&mut socket, &mut said);
        let length = within("what it says first", reading).await.unwrap();
        assert!(is_sealed(&said[..length]) && !said[..length].windows(6).any(|bytes| bytes == b"node-1"));
    });
}

#[test]
fn who_does_not_end_its_handshake_is_hung_up_on_without_a_word_that_is_no_record() {
    run(async {
        let secured = Node::start_secured_with(1, &keys(), 1, |config| {
            config.gncl.handshake = Duration::from_millis(500);
        })
        .await;
        let mut stranger = ByHand::dial(&secured).await;
        // The beginning of a record that never ends.
        stranger.say_bytes(&[0x16, 3, 1, 0x40, 0]).await;
        let mut said = Vec::new();
        let reading = tokio::io::AsyncReadExt::read_to_end(&mut stranger.socket, &mut said);
        within("the end of the connection", reading).await.unwrap();
        assert_eq!(said, [0; 0]);
        secured.counted("too late").await;
    });
}
