//! Two processes with one node address, met by the others in any order: all end with the same one.

use std::collections::BTreeSet;

use sinew_model::facts::{LinkFact, LossReason};
use sinew_runtime::{tid::Incarnation, time::Time};
use sinew_sim::{Chance, Hunt, Seeds};

use super::{
    seeds,
    world::{PERIOD, Spec, World, claimant, ms, node, udp},
};
use crate::{
    core::{Output, address_conflict::Collision},
    datagram::Claim,
};

/// The nodes without a duplicate are 1 to this at most.
const OTHERS_MAX: u16 = 4;
/// The two processes with node address 9.
const ELDER: u16 = 11;
const LATER: u16 = 12;
const BOTH: u32 = 9;
/// The seeds of an ordinary run. Each fault must be found within as many.
const SEEDS: Seeds =
    seeds("core::tests::address_claims::all_agree", if cfg!(debug_assertions) { 100 } else { 200 });

/// Returns the incarnation of the duplicated node that is a member at `index`.
fn has(world: &World, index: u16) -> Option<Incarnation> {
    world.at(index).core.members.get(&node(BOTH)).map(|member| member.announcement.incarnation)
}

fn part(world: &mut World, one: u16, other: u16) {
    world.cut(one, other);
    world.cut(other, one);
}

/// Both have settled, and cannot reach each other; no other node has started.
fn two_that_settled_apart() -> World {
    let mut world = World::new();
    part(&mut world, ELDER, LATER);
    world.start(ELDER, &Spec { incarnation: 1, ..Spec::of(BOTH) });
    world.run(PERIOD);
    world.start(LATER, &Spec { incarnation: 2, ..Spec::of(BOTH) });
    world.run(PERIOD * 8);
    world
}

// spec: NDL-5.6
#[test]
fn newcomer_that_meets_the_impostor_ends_with_the_elder() {
    // given: only the impostor reaches the newcomer
    let mut world = two_that_settled_apart();
    part(&mut world, 1, ELDER);
    world.start(1, &Spec::of(1));
    world.run(PERIOD * 3);
    assert_eq!(has(&world, 1), Some(Incarnation(2)));
    // when: the elder reaches it, but still not the impostor
    world.mend();
    part(&mut world, ELDER, LATER);
    world.run(PERIOD * 3);
    // then
    assert_eq!(has(&world, 1), Some(Incarnation(1)));
    assert_eq!(world.losses(1), [(BOTH, LossReason::Duplicate)]);
    let (holder, newcomer) = (claimant(BOTH, ELDER), claimant(BOTH, LATER));
    let both = Output::Collision { node: node(BOTH), holder, newcomer };
    assert_eq!(world.at(1).others, [both]);
    assert!(!world.gave_up(LATER), "it has received nothing from the elder");
}

// spec: NDL-5.7
#[test]
fn newer_node_yields_after_a_partition_heals() {
    // given: node 1 has lost the elder, and found the later incarnation
    let mut world = World::new();
    world.start(1, &Spec::of(1));
    world.start(2, &Spec::of(2));
    world.start(ELDER, &Spec { incarnation: 1, ..Spec::of(BOTH) });
    world.run(PERIOD * 6);
    part(&mut world, 1, ELDER);
    part(&mut world, ELDER, LATER);
    part(&mut world, 2, LATER);
    part(&mut world, 2, 1);
    world.run(PERIOD * 6);
    world.start(LATER, &Spec { incarnation: 2, ..Spec::of(BOTH) });
    world.run(PERIOD * 6);
    assert_eq!((has(&world, 1), has(&world, 2)), (Some(Incarnation(2)), Some(Incarnation(1))));
    // when
    world.mend();
    // then
    world.run_until(PERIOD * 6, |world| world.gave_up(LATER));
    world.run(PERIOD * 2);
    assert!(!world.gave_up(ELDER));
    assert_eq!((has(&world, 1), has(&world, 2)), (Some(Incarnation(1)), Some(Incarnation(1))));
}

/// The later incarnation has settled, and no datagram of it was received. The elder, which is settling, is a connected
/// member of node 1. Node 1 meets the later one while its queries to the elder are lost.
fn one_that_settled_comes_while_a_member_that_settles_is_not_reached() -> World {
    let mut world = World::new();
    world.hints_after = Some((ms(0), ms(1)));
    [1, ELDER].into_iter().for_each(|other| part(&mut world, LATER, other));
    world.start(LATER, &Spec { incarnation: 2, ..Spec::of(BOTH) });
    world.run(PERIOD * 8);
    world.start(1, &Spec::of(1));
    world.start(ELDER, &Spec { incarnation: 1, ..Spec::of(BOTH) });
    world.run(ms(100));
    assert_eq!(has(&world, 1), Some(Incarnation(1)));
    world.link(1, LinkFact::LinkUp { node: node(BOTH), incarnation: Incarnation(1) });
    world.mend();
    part(&mut world, ELDER, LATER);
    world.cut(1, ELDER);
    world.run_until(PERIOD * 2, |world| world.at(1).core.conflicts.contains_key(&node(BOTH)));
    world
}

// spec: NDL-5.3
#[test]
fn settling_member_does_not_yield_to_a_dead_one() {
    let mut world = one_that_settled_comes_while_a_member_that_settles_is_not_reached();
    // When
    world.kill(LATER);
    world.run(ms(60));
    assert_eq!(world.at(ELDER).core.announcement().claim, Claim::Settling);
    world.mend();
    // Then: the elder answers, and stays
    world.run(PERIOD * 2);
    assert_eq!((has(&world, 1), world.losses(1)), (Some(Incarnation(1)), vec![]));
    assert!(world.at(1).core.conflicts.is_empty());
}

// spec: NDL-5.3
#[test]
fn settling_member_yields_to_a_settled_living_one() {
    let mut world = one_that_settled_comes_while_a_member_that_settles_is_not_reached();
    // When: the later incarnation continues
    world.run(ms(60));
    world.mend();
    part(&mut world, ELDER, LATER);
    // Then: both are named, and the later one replaces it within its third of a challenge
    world.run_until(ms(150), |world| has(world, 1) == Some(Incarnation(2)));
    assert_eq!(world.losses(1), [(BOTH, LossReason::Duplicate)]);
    let (holder, newcomer) = (claimant(BOTH, LATER), claimant(BOTH, ELDER));
    assert_eq!(world.at(1).others, [Output::Collision { node: node(BOTH), holder, newcomer }]);
}

// spec: NDL-5.7
#[test]
fn long_frozen_node_yields_to_a_later_incarnation() {
    let mut world = World::new();
    world.start(1, &Spec::of(1));
    world.start(ELDER, &Spec { incarnation: 1, ..Spec::of(BOTH) });
    world.run(PERIOD * 6);
    world.stall(ELDER, PERIOD * 20);
    world.run(PERIOD * 5);
    world.start(LATER, &Spec { incarnation: 2, ..Spec::of(BOTH) });
    // A node that has not known the frozen one starts meanwhile.
    world.start(2, &Spec::of(2));
    world.run(PERIOD * 15 + ms(1));
    world.forget_the_past();
    world.run(PERIOD * 8);
    assert!(world.gave_up(ELDER) && !world.gave_up(LATER));
    assert_eq!((has(&world, 1), has(&world, 2)), (Some(Incarnation(2)), Some(Incarnation(2))));
    assert_eq!(
        (world.losses(1), world.losses(2)),
        (vec![], vec![]),
        "the later incarnation was not in doubt"
    );
}

/// Both settle, and reach each other for the first time when the elder's last period begins, while the later
/// incarnation has 77 ms more.
fn two_that_meet_in_the_last_period_of_settling() -> World {
    let mut world = World::new();
    part(&mut world, ELDER, LATER);
    world.start(ELDER, &Spec { incarnation: 1, ..Spec::of(BOTH) });
    world.run(ms(77));
    world.start(LATER, &Spec { incarnation: 2, ..Spec::of(BOTH) });
    world.run(PERIOD * 3 - ms(78));
    world.mend();
    world
}

// spec: NDL-5.5
#[test]
fn later_incarnation_yields_alone_to_an_almost_settled_elder() {
    let mut world = two_that_meet_in_the_last_period_of_settling();
    world.run(PERIOD * 8);
    assert!(world.gave_up(LATER) && !world.gave_up(ELDER));
    assert_eq!(world.at(ELDER).core.announcement().claim, Claim::Held);
}

// spec: NDL-5.5
#[test]
fn settling_elder_yields_to_an_unreachable_later_one() {
    for is_endless in [false, true] {
        let mut world = two_that_meet_in_the_last_period_of_settling();
        let begin = world.now;
        while !world.gave_up(ELDER) {
            assert!(world.now.since(begin) <= PERIOD * 6, "it waits forever");
            assert_eq!(world.at(ELDER).core.announcement().claim, Claim::Settling);
            // No answer matches its query any more: a datagram takes twice as long.
            world.run(world.flight / 2);
            let now = world.now;
            let later = &mut world.process(LATER).core;
            later.contacts.clear();
            if is_endless {
                later.local_node.settle(now, later.paces.rest());
            }
        }
        assert!(!world.gave_up(LATER));
        let claim = if is_endless { Claim::Settling } else { Claim::Held };
        assert_eq!(world.at(LATER).core.announcement().claim, claim);
    }
}

// spec: NDL-5.7
#[test]
fn isolated_holder_keeps_its_address_if_the_elder_yields() {
    // given: the later incarnation has settled, and has lost every peer; the elder, with a clock that was behind, is in
    // the last period of its settling
    let mut world = World::new();
    world.start(1, &Spec::of(1));
    world.start(LATER, &Spec { incarnation: 2, ..Spec::of(BOTH) });
    world.run(PERIOD * 6);
    let parted = [(1, LATER), (1, ELDER)];
    parted.into_iter().chain([(ELDER, LATER)]).for_each(|(one, other)| part(&mut world, one, other));
    world.run(PERIOD * 6);
    assert_eq!(world.losses(LATER), [(1, LossReason::LinkDown)]);
    world.start(ELDER, &Spec { incarnation: 1, ..Spec::of(BOTH) });
    world.run(PERIOD * 3 - ms(1));
    // when: each queries the other at the same moment
    world.mend();
    parted.into_iter().for_each(|(one, other)| part(&mut world, one, other));
    world.run(ms(2));
    // then: the elder has received that the other had settled
    assert!(world.gave_up(ELDER) && !world.gave_up(LATER));
    world.run(PERIOD * 8);
    assert!(!world.gave_up(LATER));
    assert_eq!(world.at(LATER).core.announcement().claim, Claim::Held);
}

#[test]
fn collision_reports_are_remembered_while_they_suppress_others() {
    let mut world = World::of_members(2);
    for nodes in [10..40, 40..41] {
        let reported = nodes.clone().count();
        for address in nodes.clone().chain(nodes) {
            world.with(udp(1), |core, now| {
                let (holder, newcomer) = (claimant(2, 2), claimant(3, 3));
                core.collide(now, Collision { node: node(address), holder, newcomer });
            });
        }
        assert_eq!(world.at(1).others.len(), reported, "each once");
        assert_eq!(world.at(1).core.conflicts.reports(), reported);
        world.run(ms(10_000));
        world.forget_the_past();
    }
}

/// A rule that is broken on purpose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fault {
    /// An elder incarnation never takes its address from a later one.
    FirstMemberKept,
    /// A settled node never gives up.
    AddressNeverYielded,
    /// A node that gives up sends no leave.
    YieldNotAnnounced,
}

fn break_it(world: &mut World, fault: Option<Fault>) {
    for process in world.processes.values_mut() {
        match fault {
            Some(Fault::FirstMemberKept) => {
                process.core.members.values_mut().for_each(|member| member.since = Time::MAX);
            }
            Some(Fault::AddressNeverYielded) => process.core.local_node.end_trial(),
            Some(Fault::YieldNotAnnounced) | None => {}
        }
    }
}

/// Runs random meetings of two processes with one address, and of others with them. In some of these the two never
/// reach each other. Returns the violation at the end.
fn meet(seed: u64, fault: Option<Fault>) -> Result<(), String> {
    let mut chance = Chance::new(seed);
    let others = 1 + chance.index(OTHERS_MAX.into()) as u16;
    let mut world = World::new();
    world.loses_leaves = fault == Some(Fault::YieldNotAnnounced);
    let all: Vec<u16> = (1..=others).chain([ELDER, LATER]).collect();
    for one in &all {
        for other in all.iter().filter(|other| *other > one) {
            let is_apart = (*one, *other) == (ELDER, LATER) || chance.happens(400);
            if is_apart {
                part(&mut world, *one, *other);
            }
        }
    }
    let mut starts: Vec<(u64, u16)> = all.iter().map(|index| (chance.below(6_000), *index)).collect();
    let elder_at = starts.iter().find(|(_, index)| *index == ELDER).map_or(0, |(at, _)| *at);
    starts.retain(|(_, index)| *index != LATER);
    starts.push((elder_at + 1 + chance.below(6_000), LATER));
    starts.sort_unstable();
    let begin = world.now;
    let mut is_frozen = false;
    for (at, index) in starts {
        let until = begin + ms(at);
        while world.now < until {
            world.run(ms(50).min(until.since(world.now)));
            break_it(&mut world, fault);
        }
        if index == LATER && chance.happens(300) {
            is_frozen = true;
            world.stall(ELDER, PERIOD * (1 + chance.index(20) as u32));
        }
        let address = if index >= ELDER { BOTH } else { index.into() };
        let spec = Spec { incarnation: u64::from(index), ..Spec::of(address) };
        world.start(index, &spec);
    }
    let wait = |world: &mut World, periods: u64| {
        for _ in 0..periods * 10 {
            world.run(PERIOD / 10);
            break_it(world, fault);
        }
    };
    wait(&mut world, 1 + chance.below(16));
    world.mend();
    let meet = is_frozen || chance.happens(700);
    if !meet {
        part(&mut world, ELDER, LATER);
    }
    // Time for settling, a trial, a loss, and the longest interval before a lost node's address is queried again.
    wait(&mut world, 5 + 5 + 4 + 18);
    let owners: BTreeSet<_> = (1..=others).map(|index| has(&world, index)).collect();
    let left: Vec<u16> = [ELDER, LATER].into_iter().filter(|index| !world.gave_up(*index)).collect();
    let owner = match left[..] {
        [owner] => Some(owner),
        [ELDER, LATER] if !meet => Some(ELDER),
        _ => None,
    };
    match owner {
        Some(owner) if owners == BTreeSet::from([Some(Incarnation(owner.into()))]) => Ok(()),
        Some(_) | None => Err(format!("{left:?} did not give up, and the others have {owners:?}")),
    }
}

#[test]
fn all_agree_in_any_order_of_meetings() {
    SEEDS.run(|seed, _| meet(seed, None));
}

#[test]
fn each_removed_rule_is_detected() {
    let faults = [Fault::FirstMemberKept, Fault::AddressNeverYielded, Fault::YieldNotAnnounced];
    let hunt = Hunt { seeds: &SEEDS, faults: &faults, within: SEEDS.count, found_last: &[] };
    hunt.run(|seed, fault, _| meet(seed, fault));
}
