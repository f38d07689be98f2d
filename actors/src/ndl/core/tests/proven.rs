//! Where nodes have keys: what a stolen node can say in datagrams ends no life that has proven itself on a connection.

use sinew_runtime::{tid::Incarnation, time::Time};

use super::world::{PERIOD, Spec, World, ms, node, udp};
use crate::{
    gncl::LinkFact,
    ndl::{
        LossReason, MembershipFact,
        datagram::{Body, Claim, Datagram, encode},
    },
};

const UNPROVEN: &str = "NDL answer of a life that is not proven";
const FIRST: Incarnation = Incarnation(1);

fn with_keys(address: u32) -> Spec {
    Spec { has_keys: true, ..Spec::of(address) }
}

fn up(incarnation: u64) -> LinkFact {
    LinkFact::LinkUp { node: node(2), incarnation: Incarnation(incarnation) }
}

/// Nodes 1 and 2, and a connection between them that has proven who they are.
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
fn a_later_life_that_answers_in_a_members_place_ends_it_when_its_connection_is_broken_and_not_before() {
    let mut world = linked();
    // When: somebody answers where node 2 is asked, as a later life of it
    world.kill(2);
    world.start(2, &Spec { incarnation: 9, ..with_keys(2) });
    world.run(PERIOD * 2);
    // Then: it is a hint, and no more
    assert_eq!(world.at(1).facts, []);
    assert!(world.at(1).core.refusals().of(UNPROVEN) > 0);
    // When: it was a restart, and the connection is found broken
    world.link(1, LinkFact::LinkBroken { node: node(2), incarnation: FIRST });
    world.run(PERIOD * 2);
    assert_eq!(world.losses(1), [(2, LossReason::Restarted)]);
    assert!(world.knows(1, 2));
}

// spec: NDL-5.2
#[test]
fn a_life_that_was_linked_before_it_was_known_bars_earlier_ones_when_it_is_lost() {
    // given: GNCL accepts the node, and NDL's datagrams are lost at first
    let mut world = World::new();
    world.cut(1, 2);
    world.cut(2, 1);
    world.start(1, &with_keys(1));
    world.start(2, &Spec { incarnation: 5, ..with_keys(2) });
    world.run(ms(100));
    world.link(1, up(5));
    world.mend();
    world.run_until(PERIOD * 2, |world| world.knows(1, 2));
    world.kill(2);
    world.run_until(PERIOD * 5, |world| !world.knows(1, 2));
    world.forget_the_past();
    // when: an earlier life answers where it was
    world.start(2, &Spec { incarnation: 3, ..with_keys(2) });
    world.run(ms(10_000));
    // then: it is refused for 15 s
    assert!(!world.knows(1, 2));
    assert!(world.at(1).core.refusals().of("NDL answer of a former life") > 0);
    world.run(ms(10_000));
    assert!(world.knows(1, 2));
}

#[test]
fn a_node_that_restarts_while_its_connection_seems_to_stand_is_found_again_after_its_loss_by_silence() {
    let mut world = linked();
    world.kill(2);
    world.start(2, &Spec { incarnation: 9, ..with_keys(2) });
    world.run(PERIOD * 6);
    assert!(matches!(world.losses(1)[..], [(2, _)]), "{:?}", world.losses(1));
    assert_eq!(world.at(1).core.members[&node(2)].announcement.incarnation, Incarnation(9));
}

// spec: NDL-5.8
#[test]
fn an_elder_life_that_is_not_proven_does_not_take_a_members_place() {
    // Given: a process that has settled in an elder life, and was not heard
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
    // When: it is heard
    world.mend();
    world.cut(2, 3);
    world.cut(3, 2);
    world.run(PERIOD * 6);
    // Then
    assert_eq!(world.at(1).facts, []);
    assert!(world.at(1).core.refusals().of(UNPROVEN) > 0);
}

// spec: NDL-5.8
#[test]
fn another_node_that_answers_where_a_connected_one_is_asked_does_not_make_it_lost() {
    let mut world = linked();
    world.kill(2);
    world.start(2, &with_keys(7));
    world.run(PERIOD);
    assert_eq!(world.at(1).facts, []);
}

// spec: NDL-5.8
#[test]
fn a_word_in_a_nodes_name_that_it_gives_its_address_up_does_not_end_its_connection() {
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
fn a_word_in_a_nodes_name_that_it_leaves_does_not_take_its_proof_away() {
    // Given: it is believed, and the node is found again
    let mut world = linked();
    let leave = world.at(2).core.announcement().clone();
    let leave = Datagram { correlation: 0, sent: Time::ZERO, body: Body::Leave(leave.into()) };
    world.forge(udp(2), 1, &encode(&leave, node(1)));
    world.run(ms(1));
    assert_eq!(world.losses(1), [(2, LossReason::Left)]);
    world.run(PERIOD * 2);
    assert!(world.knows(1, 2));
    world.forget_the_past();
    // When: a thief answers in its name, as a later life
    world.start(3, &Spec { incarnation: 9, ..with_keys(2) });
    world.run(PERIOD * 2);
    // Then
    assert_eq!(world.losses(1), []);
    assert_eq!(world.at(1).core.members[&node(2)].announcement.incarnation, FIRST);
    assert!(world.at(1).core.refusals().of(UNPROVEN) > 0);
}

// spec: NDL-5.2
#[test]
fn a_life_that_never_proved_itself_is_no_bar_to_an_earlier_one() {
    // Given: somebody answered as the last of all lives of an absent node, and was never connected
    let mut world = World::new();
    world.start(1, &with_keys(1));
    world.start(3, &Spec { incarnation: u64::MAX, ..with_keys(2) });
    world.run(ms(100));
    assert!(world.knows(1, 2));
    world.kill(3);
    world.run(PERIOD * 5);
    assert!(!world.knows(1, 2));
    // When: the node itself is back
    world.start(2, &Spec { incarnation: 5, ..with_keys(2) });
    world.run(PERIOD * 2);
    // Then
    assert_eq!(world.at(1).core.members[&node(2)].announcement.incarnation, Incarnation(5));
}

#[test]
fn who_proves_himself_on_a_connection_takes_the_place_of_who_only_answers() {
    // Given: a member that only answers, and goes on to
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
fn a_newcomer_that_only_answers_does_not_come_in_when_somebody_else_proves_himself() {
    // Given: a member that only answers, and another process that claims its address
    let mut world = World::new();
    world.start(1, &with_keys(1));
    world.start(3, &Spec { incarnation: 9, ..with_keys(2) });
    world.run(ms(100));
    world.kill(3);
    world.start(4, &Spec { incarnation: 12, ..with_keys(2) });
    world.run_until(ms(600), |world| world.at(1).core.contests.contains_key(&node(2)));
    world.forget_the_past();
    // When
    world.link(1, up(5));
    world.run(PERIOD * 2);
    // Then
    let lost =
        MembershipFact::NodeLost { node: node(2), incarnation: Incarnation(9), why: LossReason::Duplicate };
    assert_eq!(world.at(1).facts, [lost]);
    assert!(!world.knows(1, 2));
}

// spec: NDL-5.8
#[test]
fn a_member_that_proves_itself_while_a_newcomer_is_tried_stays() {
    // Given: a process that has settled, and a member in an earlier life that has not
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
    world.run_until(ms(600), |world| world.at(1).core.contests.contains_key(&node(2)));
    world.forget_the_past();
    // When: it connects, and answers
    world.link(1, up(5));
    world.run(PERIOD * 2);
    // Then
    assert_eq!(world.at(1).facts, []);
    assert_eq!(world.at(1).core.members[&node(2)].announcement.incarnation, Incarnation(5));
}
