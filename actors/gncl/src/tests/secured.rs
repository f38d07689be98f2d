//! Authenticated nodes, and the reports to those that are not.

use std::sync::Mutex;
use std::{sync::Arc, time::Duration};

use sinew_model::{
    cause::Cause,
    config::NodeConfig,
    facts::{LinkFact, LossReason, MembershipFact, User},
    ports::{AppLifecycle, Links, NodeIncarnation},
};
use sinew_runtime::{
    lock,
    outcome::Outcome,
    tid::{AppAddress, Incarnation, NodeAddress},
    wire::{Class, Kind},
};
use sinew_security::{
    DenyList, Identity,
    node_security::NodeSecurity,
    testing::{self, Authority},
};
use tokio::net::TcpListener;

use super::bench::{ByHand, Cable, NINE, Node, introduction, next, run, within};
use crate::{Event, State, authenticator::is_tls, core::write, frame::frame};

impl Node {
    /// Starts a node with keys of this project, made for a node of this number.
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

    /// The same in this incarnation.
    async fn start_secured_in(
        incarnation: Incarnation,
        number: u32,
        (keys, made_for): (&Authority, u32),
        set: impl FnOnce(&mut NodeConfig),
    ) -> Self {
        Self::begin(secured_stores(incarnation, number, (keys, made_for), set)).await
    }
}

/// Returns the state of such a node.
pub(super) fn secured_stores(
    incarnation: Incarnation,
    number: u32,
    (keys, made_for): (&Authority, u32),
    set: impl FnOnce(&mut NodeConfig),
) -> Arc<State> {
    let mut config = NodeConfig::new(format!("node-{number}"));
    config.address = Some(NodeAddress::new(number));
    set(&mut config);
    let (project, name) = (config.project.clone(), format!("node-{made_for}"));
    let made_for = Identity { project, address: NodeAddress::new(made_for), name };
    let state = State::for_test(config, incarnation);
    let credentials = keys.credentials_of(&made_for);
    let secured = NodeSecurity::new(testing::tls(&credentials), &credentials, 8, incarnation);
    assert!(state.security.secured.set(secured).is_ok(), "it is set once");
    state
}

/// Returns keys with the name of its test nodes' project.
pub(super) fn keys() -> Authority {
    Authority::new("sinew")
}

/// Two nodes with keys of one project; the second is reached over a cable.
async fn two(keys: &Authority) -> (Node, Node, Cable) {
    let mut a = Node::start_secured(1, keys, 1).await;
    let b = Node::start_secured(2, keys, 2).await;
    let cable = Cable::to(b.listens_at()).await;
    a.find(b.address(), cable.address);
    a.up().await;
    (a, b, cable)
}

#[test]
fn messages_of_any_class_and_length_pass_when_authenticated() {
    run(async {
        let (mut a, b, _cable) = two(&keys()).await;
        let (mut at_a, mut at_b) = (a.app(1), b.app(1));
        for class in [Class::Control, Class::Stream, Class::Bulk] {
            for length in [0, 8, 1_000, 16_384, 16_385, 65_536, 1_000_000] {
                let payload: Vec<u8> = (0..length).map(|at| (at % 251) as u8).collect();
                for (from, to, inbox) in [(&a, b.tid(1), &mut at_b), (&b, a.tid(1), &mut at_a)] {
                    let mut message = from.message(to, &payload);
                    message.header.class = class;
                    from.state.ctx.router.send(message).expect("somebody takes it");
                    assert_eq!(next("a message", inbox).await.payload, payload, "{class:?}");
                }
            }
        }
        a.state.ctx.router.send(a.confirmed(b.tid(1), 7)).expect("there is room for it");
        next("a message", &mut at_b).await.receipt.expect("it is to be confirmed").settle(Outcome::Delivered);
        assert_eq!(next("an outcome", &mut a.settled).await, (7, Outcome::Delivered));
    });
}

#[test]
fn flood_beyond_the_socket_arrives_in_order() {
    run(async {
        let (a, b, _cable) = two(&keys()).await;
        let mut at_b = b.app(1);
        for number in 0..500_u32 {
            let mut payload = vec![0; 20_000 + number as usize];
            payload[..4].copy_from_slice(&number.to_le_bytes());
            let mut message = a.message(b.tid(1), &payload);
            message.header.class = Class::Bulk;
            a.state.ctx.router.send(message).expect("there is room for it");
        }
        for number in 0..500_u32 {
            let message = next("a message", &mut at_b).await;
            assert_eq!(message.payload[..4], number.to_le_bytes());
            assert_eq!(message.payload.len(), 20_000 + number as usize);
        }
    });
}

#[test]
fn cuts_in_full_flow_lose_duplicate_and_reorder_nothing() {
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
fn nodes_of_two_projects_refuse_each_other() {
    run(async {
        let a = Node::start_secured(1, &keys(), 1).await;
        let b = Node::start_secured(2, &keys(), 2).await;
        a.find(b.address(), b.listens_at());
        b.counted("peer not proven").await;
        a.counted("peer not proven").await;
    });
}

#[test]
fn node_with_anothers_keys_is_accepted_as_neither() {
    run(async {
        let keys = keys();
        let a = Node::start_secured(1, &keys, 1).await;
        let thief = Node::start_secured(3, &keys, 2).await;
        thief.find(a.address(), a.listens_at());
        a.counted("security").await;
        thief.counted("refused by the peer").await;
        a.find(thief.address(), thief.listens_at());
        within("the thief's WELCOME to be refused", async {
            while a.state.store.refusals.of("security") < 2 {
                tokio::task::yield_now().await;
            }
        })
        .await;
    });
}

// spec: GNCL-18
#[test]
fn revoked_node_is_refused_on_any_link() {
    run(async {
        let (mut a, b, _cable) = two(&keys()).await;
        let mut at_a = a.app(1);
        b.send(a.tid(1), b"before");
        next("a message", &mut at_a).await;
        // When
        revoke(&a, &b);
        a.notify(Event::DenyListChanged);
        // Then: it ends with a reason
        a.broken().await;
        a.counted("security").await;
        b.counted("refused by the peer").await;
        // And: as NDL still considers it present it is dialled, and refused.
        a.counted("peer not proven").await;
    });
}

/// Records the nodes with wills that are dropped.
#[derive(Default)]
struct Revoked(Mutex<Vec<NodeIncarnation>>);

impl AppLifecycle for Revoked {
    fn began(&self, _: AppAddress, _: User) {}

    fn ended(&self, _: AppAddress, _: Cause, _: bool) {}

    fn revoke(&self, incarnation: NodeIncarnation) {
        lock(&self.0).push(incarnation);
    }
}

// spec: WILL-5
#[test]
fn wills_of_revoked_nodes_are_dropped_before_their_loss() {
    run(async {
        let (mut a, b, _cable) = two(&keys()).await;
        let (incarnation, revoked) = ((b.address(), Incarnation(1)), Arc::new(Revoked::default()));
        a.state.ctx.ports.connect_app_lifecycle(&(revoked.clone() as Arc<_>));
        let links: &dyn Links = &*a.state;
        assert_eq!(
            (links.authenticated_incarnation(incarnation.0), links.is_revoked(incarnation)),
            (Some(incarnation.1), false)
        );
        // When
        revoke(&a, &b);
        assert!(links.is_revoked(incarnation), "also before GNCL has read the list");
        a.notify(Event::DenyListChanged);
        a.broken().await;
        // Then
        assert_eq!(lock(&revoked.0)[..], [incarnation]);
    });
}

/// Nothing checks the deny list until GNCL is notified.
fn revoke(at: &Node, whose: &Node) {
    let revoked = &whose.state.security.secured.get().expect("it has keys").serial;
    let list = DenyList::read(&revoked.to_string()).expect("it is a number");
    at.state.security.secured.get().expect("it has keys").tls.deny(list);
}

/// Returns a node that a thief was linked with, as node 2 in the last of all incarnations. Its keys are on that node's
/// deny list, which GNCL does not know.
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

/// Links node 2 itself, with new keys and in an earlier incarnation, with `a`: after 5 s.
async fn itself_comes(mut a: Node, keys: &Authority) {
    let b = Node::start_secured(2, keys, 2).await;
    b.find(a.address(), a.listens_at());
    a.counted("stale incarnation").await;
    let LinkFact::LinkUp { incarnation, .. } = a.fact().await else { panic!("no other fact") };
    assert_eq!(incarnation, Incarnation(1));
}

// spec: GNCL-7
#[test]
fn thief_that_left_before_revocation_blocks_no_node() {
    run(async {
        let keys = keys();
        let a = left_by_a_thief(&keys).await;
        a.notify(Event::DenyListChanged);
        itself_comes(a, &keys).await;
    });
}

// spec: GNCL-7
#[test]
fn restarted_gncl_is_not_barred_by_a_revoked_thief() {
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
fn restarted_gncl_is_not_barred_by_a_lost_thief() {
    run(async {
        let keys = keys();
        let mut a = left_by_a_thief(&keys).await;
        a.stop_layer();
        // The state of that instance is gone.
        a.state.store.forget(NodeAddress::new(2));
        a.start_layer().await;
        let (node, incarnation) = (NodeAddress::new(2), Incarnation(u64::MAX));
        let lost = MembershipFact::NodeLost { node, incarnation, why: LossReason::Crashed };
        a.notify(Event::Membership(lost));
        itself_comes(a, &keys).await;
    });
}

#[test]
fn node_without_keys_gets_the_reason_in_both_directions() {
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
fn stranger_receives_a_plain_text_demand_for_authentication() {
    run(async {
        let secured = Node::start_secured(1, &keys(), 1).await;
        let mut stranger = ByHand::dial(&secured).await;
        let hello = introduction(secured.address());
        stranger.send(&frame(NINE, secured.address(), Kind::GNCL_HELLO, write(&hello))).await;
        let refusal = stranger.refusal().await;
        assert_eq!(refusal.cause, "security");
        assert!(refusal.sentence.contains("sinew keys issue"), "{}", refusal.sentence);
    });
}

#[test]
fn secured_dialler_sends_nothing_before_authentication() {
    run(async {
        let secured = Node::start_secured(1, &keys(), 1).await;
        let listener = TcpListener::bind("127.0.0.1:0").await.unwrap();
        secured.find(NINE, listener.local_addr().unwrap());
        let (mut socket, _) = within("the node's dial", listener.accept()).await.unwrap();
        let mut said = [0; 4_096];
        let reading = tokio::io::AsyncReadExt::read(&mut socket, &mut said);
        let length = within("what it says first", reading).await.unwrap();
        assert!(is_tls(&said[..length]) && !said[..length].windows(6).any(|bytes| bytes == b"node-1"));
    });
}

#[test]
fn unfinished_handshake_is_closed_without_plain_text() {
    run(async {
        let secured = Node::start_secured_with(1, &keys(), 1, |config| {
            config.gncl.handshake = Duration::from_millis(500);
        })
        .await;
        let mut stranger = ByHand::dial(&secured).await;
        // The beginning of an endless record.
        stranger.send_bytes(&[0x16, 3, 1, 0x40, 0]).await;
        let mut said = Vec::new();
        let reading = tokio::io::AsyncReadExt::read_to_end(&mut stranger.socket, &mut said);
        within("the end of the connection", reading).await.unwrap();
        assert_eq!(said, [0; 0]);
        secured.counted("too late").await;
    });
}
