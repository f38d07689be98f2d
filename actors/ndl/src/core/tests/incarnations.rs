//! A node has one incarnation at a time: restarts, former incarnations, two processes with one address.

use sinew_model::{
    config::WatchGroup,
    facts::{LinkFact, LossReason, MembershipFact, NodeEvent},
};
use sinew_runtime::{tid::Incarnation, time::Time};

use super::world::{PERIOD, Spec, World, claimant, ms, node, udp};
use crate::core::{Input, Output, Source};

/// Returns the time of the last datagram of node 2 at the first process.
fn last_sign_of_life(world: &World) -> Time {
    world.at(1).core.members[&node(2)].last_seen
}

fn micros_since(world: &World, then: Time) -> u64 {
    u64::try_from(world.now.since(then).as_micros()).expect("some seconds")
}

// spec: NDL-5.1
#[test]
fn restart_is_one_event_and_two_facts() {
    for (index, what) in [(2, "at the same port"), (3, "at another port")] {
        let mut world = World::of_members(2);
        let last_seen = last_sign_of_life(&world);
        world.kill(2);
        world.run(ms(20));
        world.start(index, &Spec { incarnation: 2, ..Spec::of(2) });
        world.run_until(ms(150), |world| !world.at(1).events.is_empty());
        let restarted = NodeEvent::NodeRestarted {
            node: node(2),
            name: "node-2".into(),
            incarnation: Incarnation(2),
            silent_us: micros_since(&world, last_seen),
            bound_us: 2_000_000,
        };
        assert_eq!(world.at(1).events, [restarted], "{what}");
        let [lost, found] = &world.at(1).facts[..] else { panic!("{what}: {:?}", world.at(1).facts) };
        let why = LossReason::Restarted;
        assert_eq!(*lost, MembershipFact::NodeLost { node: node(2), incarnation: Incarnation(1), why });
        assert!(matches!(found, MembershipFact::NodeFound { incarnation: Incarnation(2), .. }));
        world.run(PERIOD * 10);
        assert_eq!(world.at(1).facts.len(), 2, "{what}: and then all is quiet");
    }
}

// spec: NDL-5.1
#[test]
fn restart_after_a_loss_reports_the_silence() {
    let mut world = World::of_members(2);
    let last_seen = last_sign_of_life(&world);
    world.kill(2);
    world.run(PERIOD * 5);
    world.start(2, &Spec { incarnation: 2, ..Spec::of(2) });
    world.run_until(ms(10), |world| world.at(1).events.len() == 2);
    let [NodeEvent::NodeLost { silent_us: lost, .. }, NodeEvent::NodeRestarted { silent_us, bound_us, .. }] =
        world.at(1).events[..]
    else {
        panic!("{:?}", world.at(1).events)
    };
    assert_eq!((silent_us, bound_us), (micros_since(&world, last_seen), 2_000_000));
    assert!(lost <= bound_us && silent_us > bound_us, "{lost}, then {silent_us}");
}

// spec: NDL-5.1
#[test]
fn restart_bound_follows_the_pace_of_the_previous_incarnation() {
    let mut world = World::new();
    let watch = vec![WatchGroup { nodes: vec!["node-2".to_owned()], period: ms(10), missed_max: 2 }];
    world.start(1, &Spec { watch, ..Spec::of(1) });
    world.start(2, &Spec::of(2));
    world.run(ms(105));
    world.forget_the_past();
    world.kill(2);
    world.run(ms(5));
    world.start(2, &Spec { incarnation: 2, ..Spec::of(2) });
    world.run_until(ms(20), |world| !world.at(1).events.is_empty());
    let [NodeEvent::NodeRestarted { silent_us, bound_us: 30_000, .. }] = world.at(1).events[..] else {
        panic!("{:?}", world.at(1).events)
    };
    assert!((5_000..=30_000).contains(&silent_us), "{silent_us}");
}

// spec: NDL-5.2
#[test]
fn former_incarnation_stays_refused_after_a_loss() {
    // given: incarnation 6 is lost, and 7 found, which cannot reach it
    let mut world = World::new();
    world.start(1, &Spec::of(1));
    world.start(3, &Spec { incarnation: 6, ..Spec::of(2) });
    world.run(ms(10));
    for (from, to) in [(1, 3), (3, 1), (2, 3), (3, 2)] {
        world.cut(from, to);
    }
    world.run(PERIOD * 5);
    world.start(2, &Spec { incarnation: 7, ..Spec::of(2) });
    world.run(PERIOD * 5);
    // when: incarnation 6 is received again
    world.mend();
    world.cut(2, 3);
    world.cut(3, 2);
    world.run(PERIOD * 2);
    // then
    assert!(world.at(1).core.refusals().of("NDL answer of a former incarnation") > 0);
    assert_eq!(world.at(1).core.members[&node(2)].announcement.incarnation, Incarnation(7));
    world.kill(2);
    world.run(PERIOD * 8);
    assert!(!world.has_member(1, 2));
}

// spec: NDL-5.2
#[test]
fn node_with_a_reset_clock_is_refused_temporarily() {
    // Given: a node that was lost
    let mut world = World::new();
    world.start(1, &Spec::of(1));
    world.start(2, &Spec { incarnation: 1_000_000, ..Spec::of(2) });
    world.run(ms(100));
    let last_seen = last_sign_of_life(&world);
    world.kill(2);
    world.run_until(PERIOD * 5, |world| !world.has_member(1, 2));
    world.forget_the_past();
    // When: it is back, and its clock shows 1970
    world.start(2, &Spec { incarnation: 3, ..Spec::of(2) });
    world.run(ms(14_900));
    assert_eq!(world.at(1).facts, []);
    assert!(world.at(1).core.refusals().of("NDL answer of a former incarnation") > 0);
    world.run_until(PERIOD * 2, |world| !world.at(1).events.is_empty());
    // Then: the known later incarnation bars it no more
    let [found] = &world.at(1).facts[..] else { panic!("{:?}", world.at(1).facts) };
    let forgotten = Output::Forgotten { node: node(2), incarnation: Incarnation(1_000_000) };
    assert_eq!(world.at(1).others, [forgotten], "GNCL is notified, too");
    assert!(matches!(found, MembershipFact::NodeFound { incarnation: Incarnation(3), .. }));
    let restarted = NodeEvent::NodeRestarted {
        node: node(2),
        name: "node-2".into(),
        incarnation: Incarnation(3),
        silent_us: micros_since(&world, last_seen),
        bound_us: 2_000_000,
    };
    assert_eq!(world.at(1).events, [restarted]);
}

// spec: NDL-5.4
#[test]
fn newcomer_with_a_living_nodes_address_is_refused() {
    for incarnation in [1, 2] {
        // given: the newcomer knows nothing of the holder
        let mut world = World::of_members(2);
        world.cut(2, 3);
        world.cut(3, 2);
        // when
        world.start(3, &Spec { incarnation, ..Spec::of(2) });
        world.run(PERIOD * 6);
        // then
        assert_eq!(world.at(1).facts, [], "incarnation {incarnation}");
        let collision = Output::Collision { node: node(2), holder: claimant(2, 2), newcomer: claimant(2, 3) };
        assert_eq!(world.at(1).others, [collision], "reported once in 10 s");
        assert!(world.at(1).core.refusals().of("NDL node address used twice") > 1);
        // when: the holder goes
        world.kill(2);
        world.run(PERIOD * 8);
        // then: a later incarnation takes over, an equal one never does
        assert_eq!(world.has_member(1, 2), incarnation == 2);
    }
}

#[test]
fn starved_node_queries_again_before_it_replaces_a_member() {
    let mut world = World::of_members(2);
    world.cut(2, 3);
    world.cut(3, 2);
    world.start(3, &Spec { incarnation: 2, ..Spec::of(2) });
    world.run_until(ms(10), |world| !world.at(1).core.conflicts.is_empty());
    world.stall(1, ms(200));
    world.run(PERIOD * 2);
    assert_eq!(world.at(1).facts, []);
}

/// Node 1 tries a later incarnation of node 2 at another address, and its queries do not reach the member; the two with
/// one address do not reach each other.
fn with_a_newcomer_and_a_member_that_is_not_reached() -> World {
    let mut world = World::of_members(2);
    [(1, 2), (2, 3), (3, 2)].into_iter().for_each(|(from, to)| world.cut(from, to));
    world.start(3, &Spec { incarnation: 2, ..Spec::of(2) });
    world.run_until(ms(10), |world| !world.at(1).core.conflicts.is_empty());
    world
}

// spec: NDL-5.3
#[test]
fn unreached_member_stays_when_the_newcomer_gives_up() {
    for loses_leaves in [false, true] {
        let mut world = with_a_newcomer_and_a_member_that_is_not_reached();
        world.loses_leaves = loses_leaves;
        // when: the newcomer receives a datagram of the member
        world.mend();
        world.cut(1, 2);
        world.input(3, Input::AddressNamed { source: Source::Mdns, address: udp(2) });
        world.run(ms(5));
        assert_eq!(world.at(3).others, [Output::AddressTaken { holder: claimant(2, 2) }]);
        // then
        assert_eq!(world.at(1).core.conflicts.is_empty(), !loses_leaves, "its leave ends it");
        world.run(ms(200));
        assert!(world.at(1).core.conflicts.is_empty(), "and so does its silence");
        world.mend();
        world.run(PERIOD * 6);
        assert_eq!(world.at(1).facts, []);
    }
}

// spec: NDL-5.3
#[test]
fn unreached_member_with_signs_of_life_stays() {
    let mut world = with_a_newcomer_and_a_member_that_is_not_reached();
    assert_eq!(world.at(1).core.in_doubt(), [(node(2), Incarnation(1))]);
    world.link(1, LinkFact::LinkUp { node: node(2), incarnation: Incarnation(1) });
    for _ in 0..100 {
        let (node, incarnation, at) = (node(2), Incarnation(1), world.now);
        world.input(1, Input::HintReceived { node, incarnation, at });
        world.run(ms(20));
    }
    assert_eq!(world.at(1).facts, []);
    let both = Output::Collision { node: node(2), holder: claimant(2, 2), newcomer: claimant(2, 3) };
    assert_eq!(world.at(1).others, [both], "both are named");
    // when: it has ended
    world.kill(2);
    world.link(1, LinkFact::LinkBroken { node: node(2), incarnation: Incarnation(1) });
    world.run(PERIOD * 2);
    // then
    assert_eq!(world.losses(1), [(2, LossReason::Restarted)]);
}

// spec: NDL-5.3
#[test]
fn restart_elsewhere_is_reported_after_the_members_time() {
    // A third of its time is for liveness hints of the member that are in flight when the newcomer answers.
    for (lasts, at_most) in [(ms(0), ms(135)), (ms(110), ms(60))] {
        let mut world = World::of_members(2);
        world.kill(2);
        world.start(3, &Spec { incarnation: 2, ..Spec::of(2) });
        world.run_until(ms(10), |world| !world.at(1).core.conflicts.is_empty());
        world.cut(3, 1);
        world.run(lasts);
        world.mend();
        world.run_until(at_most, |world| !world.at(1).facts.is_empty());
        assert_eq!(world.losses(1), [(2, LossReason::Restarted)]);
        assert_eq!(world.at(1).others, [], "no collision is reported");
    }
}

/// The newcomer has answered, and its part of the time is not over, as long as the last query to it is in flight.
fn with_a_newcomer_that_has_answered() -> World {
    let mut world = with_a_newcomer_and_a_member_that_is_not_reached();
    world.run_until(ms(110), |world| {
        world.at(1).core.conflicts.values().any(|conflict| conflict.has_answered)
    });
    world
}

// spec: NDL-5.3
#[test]
fn node_stalled_after_the_newcomers_answer_queries_again() {
    let mut world = with_a_newcomer_that_has_answered();
    // when: the newcomer ends meanwhile
    world.stall(1, ms(300));
    world.kill(3);
    world.run(PERIOD * 6);
    // then
    assert_eq!(world.losses(1), []);
}

// spec: NDL-5.3
#[test]
fn member_that_connects_after_the_newcomers_answer_stays() {
    let mut world = with_a_newcomer_that_has_answered();
    world.link(1, LinkFact::LinkUp { node: node(2), incarnation: Incarnation(1) });
    world.run(ms(100));
    assert_eq!(world.at(1).facts, []);
}

// spec: NDL-5.3
#[test]
fn no_false_restart_with_each_fifth_datagram_lost() {
    for begin in 0..50 {
        let mut world = World::of_members(3);
        world.cut(2, 4);
        world.cut(4, 2);
        world.loses_each = Some(5);
        world.run(ms(begin * 11));
        world.start(4, &Spec { incarnation: 2, ..Spec::of(2) });
        world.run(PERIOD * 20);
        assert_eq!((world.losses(1), world.losses(3)), (vec![], vec![]), "after {begin} times 11 ms");
    }
}

// spec: NDL-5.5
#[test]
fn newcomer_with_an_address_in_use_gives_up_alone() {
    let mut world = World::of_members(2);
    world.run(PERIOD * 5);
    world.start(3, &Spec::of(2));
    world.run(ms(10));
    assert_eq!(world.at(3).others, [Output::AddressTaken { holder: claimant(2, 2) }]);
    assert_eq!(world.at(3).core.next_wake(), None, "it is silent from now on");
    let both = Output::Collision { node: node(2), holder: claimant(2, 2), newcomer: claimant(2, 3) };
    assert_eq!(world.at(2).others, [both]);
    assert_eq!(world.at(1).facts, []);
}

// spec: NDL-5.5
#[test]
fn later_of_two_simultaneous_starts_gives_up_alone() {
    let mut world = World::new();
    world.start(1, &Spec::of(1));
    world.start(2, &Spec::of(2));
    world.start(3, &Spec { incarnation: 2, ..Spec::of(2) });
    world.run(PERIOD * 6);
    assert!(world.gave_up(3));
    assert!(!world.gave_up(2));
    assert!(world.has_member(1, 2));
}
