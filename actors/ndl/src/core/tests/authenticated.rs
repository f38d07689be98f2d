//! Nodes with keys: no datagram of a stolen node ends an incarnation that has authenticated itself on a connection.

use sinew_model::facts::{LinkFact, LossReason, MembershipFact};
use sinew_runtime::{tid::Incarnation, time::Time};

use super::world::{PERIOD, Spec, World, ms, node, udp};
use crate::datagram::{Body, Claim, Datagram, encode};

const UNAUTHENTICATED: &str = "NDL answer of an unauthenticated incarnation";
const FIRST: Incarnation = Incarnation(1);

fn with_keys(address: u32) -> Spec {
    Spec { has_keys: true, ..Spec::of(address) }
}

fn up(incarnation: u64) -> LinkFact {
    LinkFact::LinkUp { node: node(2), incarnation: Incarnation(incarnation) }
}

/// Nodes 1 and 2, with an authenticated connection between them.
fn linked() -> World {
    let mut world = World::new();
    (1..=2).for_each(|index| world.start(index, &with_keys(index.into())));
    world.run(ms(100));
    world.link(1, up(1));
    world.forget_the_past();
    world
}

// spec: NDL-5.8
#[test]
fn later_incarnation_waits_for_the_end_of_a_link() {
    let mut world = linked();
    // When: a process answers at node 2's address, as a later incarnation of it
    world.kill(2);
    world.start(2, &Spec { incarnation: 9, ..with_keys(2) });
    world.run(PERIOD * 2);
    // Then: it is a hint, and no more
    assert_eq!(world.at(1).facts, []);
    assert!(world.at(1).core.refusals().of(UNAUTHENTICATED) > 0);
    // When: it was a restart, and the connection is found to be broken
    world.link(1, LinkFact::LinkBroken { node: node(2), incarnation: FIRST });
    world.run(PERIOD * 2);
    assert_eq!(world.losses(1), [(2, LossReason::Restarted)]);
    assert!(world.has_member(1, 2));
}

// spec: NDL-5.2
#[test]
fn linked_incarnation_bars_earlier_ones_after_its_loss() {
    // given: GNCL accepts the node, and NDL's datagrams are lost at first
    let mut world = World::new();
    world.cut(1, 2);
    world.cut(2, 1);
    world.start(1, &with_keys(1));
    world.start(2, &Spec { incarnation: 5, ..with_keys(2) });
    world.run(ms(100));
    world.link(1, up(5));
    world.mend();
    world.run_until(PERIOD * 2, |world| world.has_member(1, 2));
    world.kill(2);
    world.run_until(PERIOD * 5, |world| !world.has_member(1, 2));
    world.forget_the_past();
    // when: an earlier incarnation answers at its address
    world.start(2, &Spec { incarnation: 3, ..with_keys(2) });
    world.run(ms(10_000));
    // then: it is refused for 15 s
    assert!(!world.has_member(1, 2));
    assert!(world.at(1).core.refusals().of("NDL answer of a former incarnation") > 0);
    world.run(ms(10_000));
    assert!(world.has_member(1, 2));
}

#[test]
fn restarted_node_with_a_stale_connection_is_found() {
    let mut world = linked();
    world.kill(2);
    world.start(2, &Spec { incarnation: 9, ..with_keys(2) });
    world.run(PERIOD * 6);
    assert!(matches!(world.losses(1)[..], [(2, _)]), "{:?}", world.losses(1));
    assert_eq!(world.at(1).core.members[&node(2)].announcement.incarnation, Incarnation(9));
}

// spec: NDL-5.8
#[test]
fn unauthenticated_elder_does_not_replace_a_member() {
    // Given: a process that has settled in an elder incarnation, without any received datagram
    let mut world = World::new();
    world.start(3, &Spec { incarnation: 1, ..with_keys(2) });
    world.run(PERIOD * 6);
    for (from, to) in [(1, 3), (3, 1), (2, 3), (3, 2)] {
        world.cut(from, to);
    }
    world.start(1, &with_keys(1));
    world.start(2, &Spec { incarnation: 5, ..with_keys(2) });
    world.run(PERIOD * 6);
    world.link(1, up(5));
    world.forget_the_past();
    // When: its datagrams arrive
    world.mend();
    world.cut(2, 3);
    world.cut(3, 2);
    world.run(PERIOD * 6);
    // Then
    assert_eq!(world.at(1).facts, []);
    assert!(world.at(1).core.refusals().of(UNAUTHENTICATED) > 0);
}

// spec: NDL-5.8
#[test]
fn another_nodes_answer_does_not_lose_a_connected_member() {
    let mut world = linked();
    world.kill(2);
    world.start(2, &with_keys(7));
    world.run(PERIOD);
    assert_eq!(world.at(1).facts, []);
}

// spec: NDL-5.8
#[test]
fn forged_yield_does_not_end_a_connection() {
    let mut world = linked();
    let mut announcement = world.at(2).core.announcement().clone();
    announcement.claim = Claim::Yielded;
    let leave = Datagram { correlation: 0, sent: Time::ZERO, body: Body::Leave(announcement.into()) };
    world.forge(udp(2), 1, &encode(&leave, node(1)));
    world.run(ms(1));
    assert_eq!(world.at(1).facts, []);
}

// spec: NDL-5.8
#[test]
fn forged_leave_keeps_the_authentication() {
    // Given: it is accepted, and the node is found again
    let mut world = linked();
    let leave = world.at(2).core.announcement().clone();
    let leave = Datagram { correlation: 0, sent: Time::ZERO, body: Body::Leave(leave.into()) };
    world.forge(udp(2), 1, &encode(&leave, node(1)));
    world.run(ms(1));
    assert_eq!(world.losses(1), [(2, LossReason::Left)]);
    world.run(PERIOD * 2);
    assert!(world.has_member(1, 2));
    world.forget_the_past();
    // When: another process answers in its name, as a later incarnation
    world.start(3, &Spec { incarnation: 9, ..with_keys(2) });
    world.run(PERIOD * 2);
    // Then
    assert_eq!(world.losses(1), []);
    assert_eq!(world.at(1).core.members[&node(2)].announcement.incarnation, FIRST);
    assert!(world.at(1).core.refusals().of(UNAUTHENTICATED) > 0);
}

// spec: NDL-5.2
#[test]
fn unauthenticated_incarnation_does_not_bar_an_earlier_one() {
    // Given: a process answered as the last of all incarnations of an absent node, and was never connected
    let mut world = World::new();
    world.start(1, &with_keys(1));
    world.start(3, &Spec { incarnation: u64::MAX, ..with_keys(2) });
    world.run(ms(100));
    assert!(world.has_member(1, 2));
    world.kill(3);
    world.run(PERIOD * 5);
    assert!(!world.has_member(1, 2));
    // When: the node itself is back
    world.start(2, &Spec { incarnation: 5, ..with_keys(2) });
    world.run(PERIOD * 2);
    // Then
    assert_eq!(world.at(1).core.members[&node(2)].announcement.incarnation, Incarnation(5));
}

#[test]
fn authenticated_node_replaces_an_unauthenticated_member() {
    // Given: a member that only answers, and continues to
    let mut world = World::new();
    world.start(1, &with_keys(1));
    world.start(3, &Spec { incarnation: 9, ..with_keys(2) });
    world.run(ms(100));
    world.cut(2, 3);
    world.cut(3, 2);
    // When
    world.start(2, &Spec { incarnation: 5, ..with_keys(2) });
    world.link(1, up(5));
    world.run(PERIOD * 4);
    // Then
    assert_eq!(world.losses(1), [(2, LossReason::Duplicate)]);
    assert_eq!(world.at(1).core.members[&node(2)].announcement.incarnation, Incarnation(5));
    let lost =
        MembershipFact::NodeLost { node: node(2), incarnation: Incarnation(9), why: LossReason::Duplicate };
    assert!(world.at(1).facts.contains(&lost));
}

// spec: NDL-5.8
#[test]
fn unauthenticated_newcomer_does_not_join_by_anothers_connection() {
    // Given: a member that only answers, and another process that claims its address
    let mut world = World::new();
    world.start(1, &with_keys(1));
    world.start(3, &Spec { incarnation: 9, ..with_keys(2) });
    world.run(ms(100));
    world.kill(3);
    world.start(4, &Spec { incarnation: 12, ..with_keys(2) });
    world.run_until(ms(600), |world| world.at(1).core.conflicts.contains_key(&node(2)));
    world.forget_the_past();
    // When
    world.link(1, up(5));
    world.run(PERIOD * 2);
    // Then
    let lost =
        MembershipFact::NodeLost { node: node(2), incarnation: Incarnation(9), why: LossReason::Duplicate };
    assert_eq!(world.at(1).facts, [lost]);
    assert!(!world.has_member(1, 2));
}

// spec: NDL-5.8
#[test]
fn member_that_authenticates_during_a_conflict_stays() {
    // Given: a process that has settled, and a member in an earlier incarnation that has not
    let mut world = World::new();
    world.start(3, &Spec { incarnation: 9, ..with_keys(2) });
    world.run(PERIOD * 6);
    for (from, to) in [(1, 3), (3, 1), (2, 3), (3, 2)] {
        world.cut(from, to);
    }
    world.start(1, &with_keys(1));
    world.start(2, &Spec { incarnation: 5, ..with_keys(2) });
    world.run(ms(100));
    world.mend();
    world.cut(2, 3);
    world.cut(3, 2);
    world.run_until(ms(600), |world| world.at(1).core.conflicts.contains_key(&node(2)));
    world.forget_the_past();
    // When: it connects, and answers
    world.link(1, up(5));
    world.run(PERIOD * 2);
    // Then
    assert_eq!(world.at(1).facts, []);
    assert_eq!(world.at(1).core.members[&node(2)].announcement.incarnation, Incarnation(5));
}
