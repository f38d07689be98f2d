//! Where nodes have keys: whose questions are signs that he lives, and which of them. spec: NDL-4.7

use std::time::Duration;

use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::world::{PERIOD, Spec, World, ms, node, udp};
use crate::{
    gncl::LinkFact,
    ndl::{
        LossReason,
        core::{Input, clock::PeerClock},
        datagram::{Body, Datagram, encode},
    },
};

const LIFE: Incarnation = Incarnation(1);
/// The clock of node 2 minus that of the world.
const AHEAD_NS: i64 = 7_000_000_000;

/// Nodes 1 and 2 have keys and know each other.
fn two() -> World {
    let mut world = World::new();
    world.start(1, &Spec { has_keys: true, ..Spec::of(1) });
    world.start(2, &Spec { has_keys: true, clock_ns: AHEAD_NS, ..Spec::of(2) });
    world.run(ms(100));
    assert!(world.knows(1, 2) && world.knows(2, 1));
    world.forget_the_past();
    world
}

/// The same, and a connection between them that has proven who they are.
fn linked() -> World {
    let mut world = two();
    world.link(1, LinkFact::LinkUp { node: node(2), incarnation: LIFE });
    world
}

fn clock_of_2(world: &World) -> Time {
    world.now.shifted(AHEAD_NS)
}

/// What node 2 says when it asks now.
fn question(world: &World) -> Vec<u8> {
    let body = Body::Query(world.at(2).core.announcement().clone());
    encode(&Datagram { correlation: 7, sent: clock_of_2(world), body }, NodeAddress::ALL).to_vec()
}

/// Node 2 dies, and somebody has these come to node 1 afterwards, two in a period. How long it takes until node 1 has lost it, or all have come.
fn kept_by(world: &mut World, questions: Vec<Vec<u8>>) -> Duration {
    let died = world.now;
    world.kill(2);
    for question in questions {
        if !world.knows(1, 2) {
            break;
        }
        world.forge(udp(2), 1, &question);
        world.run(PERIOD / 2);
    }
    world.now.since(died)
}

/// Node 2 reads of node 1 on its connection, and so goes on to ask it.
fn asks_on(world: &mut World, duration: Duration) {
    let end = world.now + duration;
    while world.now < end {
        let (node, incarnation, at) = (node(1), LIFE, clock_of_2(world));
        world.input(2, Input::SignSeen { node, incarnation, at });
        world.run(PERIOD / 10);
    }
}

#[test]
fn a_recorded_question_that_is_sent_again_keeps_nobody_who_is_not_connected() {
    let mut world = two();
    let recorded = question(&world);
    let kept = kept_by(&mut world, vec![recorded; 40]);
    assert!(kept <= PERIOD * 5, "{kept:?}");
    assert_eq!(world.losses(1), [(2, LossReason::LinkDown)]);
}

#[test]
fn questions_that_are_held_back_keep_who_died_only_while_they_are_new() {
    // Given: many were held back, and nobody has found yet that the connection is dead
    let mut world = linked();
    let held_back = (0..40).map(|_| {
        world.run(ms(1));
        question(&world)
    });
    let held_back = held_back.collect();
    // When
    let kept = kept_by(&mut world, held_back);
    // Then: as long as they are new, as long as they count, and until it is looked
    assert!(kept >= PERIOD * 5 && kept <= PERIOD * 8, "{kept:?}");
    assert_eq!(world.losses(1), [(2, LossReason::LinkDown)]);
}

#[test]
fn who_is_connected_and_asks_us_is_not_lost_though_nothing_that_we_say_reaches_it() {
    let mut world = linked();
    world.cut(1, 2);
    asks_on(&mut world, PERIOD * 20);
    assert_eq!(world.losses(1), []);
    assert!(world.at(1).core.members(world.now)[0].missed > 15);
    // And from when its connection has ended its questions are no signs.
    world.link(1, LinkFact::LinkBroken { node: node(2), incarnation: LIFE });
    asks_on(&mut world, PERIOD * 5);
    assert_eq!(world.losses(1), [(2, LossReason::LinkDown)]);
}

#[test]
fn of_whose_clock_nothing_is_known_questions_are_no_signs() {
    let mut world = linked();
    world.cut(1, 2);
    let members = &mut world.process(1).core.members;
    members.get_mut(&node(2)).expect("it is a member").clock = PeerClock::default();
    asks_on(&mut world, PERIOD * 6);
    assert_eq!(world.losses(1), [(2, LossReason::LinkDown)]);
}
