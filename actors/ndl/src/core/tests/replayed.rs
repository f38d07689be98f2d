//! Nodes with keys: the queries that count as liveness hints. spec: NDL-4.7

use std::time::Duration;

use sinew_model::facts::{LinkFact, LossReason};
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::world::{PERIOD, Spec, World, ms, node, udp};
use crate::{
    core::{Input, clock::PeerClock},
    datagram::{Body, Datagram, encode},
};

const INCARNATION: Incarnation = Incarnation(1);
/// The clock of node 2 minus that of the world.
const AHEAD_NS: i64 = 7_000_000_000;

/// Nodes 1 and 2 have keys and know each other.
fn two() -> World {
    let mut world = World::new();
    world.start(1, &Spec { has_keys: true, ..Spec::of(1) });
    world.start(2, &Spec { has_keys: true, clock_ns: AHEAD_NS, ..Spec::of(2) });
    world.run(ms(100));
    assert!(world.has_member(1, 2) && world.has_member(2, 1));
    world.forget_the_past();
    world
}

/// The same, with an authenticated connection between them.
fn linked() -> World {
    let mut world = two();
    world.link(1, LinkFact::LinkUp { node: node(2), incarnation: INCARNATION });
    world
}

fn clock_of_2(world: &World) -> Time {
    world.now.shifted(AHEAD_NS)
}

/// Returns a query of node 2, sent now.
fn question(world: &World) -> Vec<u8> {
    let body = Body::Query(world.at(2).core.announcement().clone());
    encode(&Datagram { correlation: 7, sent: clock_of_2(world), body }, NodeAddress::ALL).to_vec()
}

/// Kills node 2 and replays these queries to node 1 afterwards, two per period. Returns the time until node 1 has lost
/// it, or all were replayed.
fn kept_by(world: &mut World, questions: Vec<Vec<u8>>) -> Duration {
    let died = world.now;
    world.kill(2);
    for question in questions {
        if !world.has_member(1, 2) {
            break;
        }
        world.forge(udp(2), 1, &question);
        world.run(PERIOD / 2);
    }
    world.now.since(died)
}

/// Lets node 2 receive data of node 1 on its connection, so that it continues to query it.
fn asks_on(world: &mut World, duration: Duration) {
    let end = world.now + duration;
    while world.now < end {
        let (node, incarnation, at) = (node(1), INCARNATION, clock_of_2(world));
        world.input(2, Input::HintReceived { node, incarnation, at });
        world.run(PERIOD / 10);
    }
}

#[test]
fn replayed_query_keeps_no_unconnected_node() {
    let mut world = two();
    let recorded = question(&world);
    let kept = kept_by(&mut world, vec![recorded; 40]);
    assert!(kept <= PERIOD * 5, "{kept:?}");
    assert_eq!(world.losses(1), [(2, LossReason::LinkDown)]);
}

#[test]
fn delayed_queries_keep_a_dead_node_only_while_recent() {
    // Given: many queries were held back, and the dead connection has not been detected
    let mut world = linked();
    let held_back = (0..40).map(|_| {
        world.run(ms(1));
        question(&world)
    });
    let held_back = held_back.collect();
    // When
    let kept = kept_by(&mut world, held_back);
    // Then: as long as they are recent, as long as they count, and until the next check
    assert!(kept >= PERIOD * 5 && kept <= PERIOD * 8, "{kept:?}");
    assert_eq!(world.losses(1), [(2, LossReason::LinkDown)]);
}

#[test]
fn connected_node_that_queries_us_stays_without_our_datagrams() {
    let mut world = linked();
    world.cut(1, 2);
    asks_on(&mut world, PERIOD * 20);
    assert_eq!(world.losses(1), []);
    assert!(world.at(1).core.members(world.now)[0].missed > 15);
    // And: after the end of its connection its queries are no hints.
    world.link(1, LinkFact::LinkBroken { node: node(2), incarnation: INCARNATION });
    asks_on(&mut world, PERIOD * 5);
    assert_eq!(world.losses(1), [(2, LossReason::LinkDown)]);
}

#[test]
fn queries_from_an_unknown_clock_are_no_hints() {
    let mut world = linked();
    world.cut(1, 2);
    let members = &mut world.process(1).core.members;
    members.get_mut(&node(2)).expect("it is a member").clock = PeerClock::default();
    asks_on(&mut world, PERIOD * 6);
    assert_eq!(world.losses(1), [(2, LossReason::LinkDown)]);
}
