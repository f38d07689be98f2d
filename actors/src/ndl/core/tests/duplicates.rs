//! Two processes with one node address, in whatever order the others meet them: all end with the same one.

use std::collections::BTreeSet;

use sinew_runtime::{tid::Incarnation, time::Time};

use super::world::{PERIOD, Spec, World, claimant, ms, node, udp};
use crate::{
    gncl::LinkFact,
    ndl::{
        LossReason,
        core::{
            Output,
            simulation::{Chance, SEED_VARIABLE, SEEDS_VARIABLE},
        },
        datagram::Claim,
    },
    seeded::{Seed, number},
};

/// The nodes that have no double are 1 to this at most.
const OTHERS_MAX: u16 = 4;
/// The two processes with node address 9.
const ELDER: u16 = 11;
const LATER: u16 = 12;
const BOTH: u32 = 9;
/// Seeds in an ordinary run, and those within which each fault must be found.
const SEEDS: u64 = if cfg!(debug_assertions) { 100 } else { 200 };

/// The life of the doubled node that `index` has.
fn has(world: &World, index: u16) -> Option<Incarnation> {
    world.at(index).core.members.get(&node(BOTH)).map(|member| member.announcement.incarnation)
}

fn part(world: &mut World, one: u16, other: u16) {
    world.cut(one, other);
    world.cut(other, one);
}

/// Both have settled, and cannot hear each other; nobody else is there yet.
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
fn a_newcomer_that_meets_the_impostor_first_ends_with_the_elder_life_and_names_both() {
    // given: the newcomer hears the impostor alone
    let mut world = two_that_settled_apart();
    part(&mut world, 1, ELDER);
    world.start(1, &Spec::of(1));
    world.run(PERIOD * 3);
    assert_eq!(has(&world, 1), Some(Incarnation(2)));
    // when: it hears the elder, which the impostor still does not
    world.mend();
    part(&mut world, ELDER, LATER);
    world.run(PERIOD * 3);
    // then
    assert_eq!(has(&world, 1), Some(Incarnation(1)));
    assert_eq!(world.losses(1), [(BOTH, LossReason::Duplicate)]);
    let (holder, newcomer) = (claimant(BOTH, ELDER), claimant(BOTH, LATER));
    let both = Output::Collision { node: node(BOTH), holder, newcomer };
    assert_eq!(world.at(1).others, [both]);
    assert!(!world.gave_up(LATER), "it has not heard of the elder");
}

// spec: NDL-5.7
#[test]
fn of_two_that_settled_apart_the_later_life_gives_up_when_they_meet_and_who_had_it_takes_the_elder_back() {
    // given: node 1 has lost the elder, and found the later life
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

/// The later life has settled, and nobody heard it; the elder, which settles, is a member of node 1, whose connection with it stands. Node 1 meets
/// the later life while its questions to the elder are lost.
fn one_that_settled_comes_while_a_member_that_settles_is_not_reached() -> World {
    let mut world = World::new();
    world.signs_after = Some((ms(0), ms(1)));
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
    world.run_until(PERIOD * 2, |world| world.at(1).core.contests.contains_key(&node(BOTH)));
    world
}

// spec: NDL-5.3
#[test]
fn a_member_that_settles_and_lives_is_not_replaced_by_one_that_had_settled_and_is_gone_since() {
    let mut world = one_that_settled_comes_while_a_member_that_settles_is_not_reached();
    // When
    world.kill(LATER);
    world.run(ms(60));
    assert_eq!(world.at(ELDER).core.announcement().claim, Claim::Settling);
    world.mend();
    // Then: the elder answers, and stays
    world.run(PERIOD * 2);
    assert_eq!((has(&world, 1), world.losses(1)), (Some(Incarnation(1)), vec![]));
    assert!(world.at(1).core.contests.is_empty());
}

// spec: NDL-5.3
#[test]
fn a_member_that_settles_gives_way_to_one_that_has_settled_and_shows_again_that_it_lives() {
    let mut world = one_that_settled_comes_while_a_member_that_settles_is_not_reached();
    // When: the later life lives on
    world.run(ms(60));
    world.mend();
    part(&mut world, ELDER, LATER);
    // Then: both are named, and it follows within the third of a challenge that it has
    world.run_until(ms(150), |world| has(world, 1) == Some(Incarnation(2)));
    assert_eq!(world.losses(1), [(BOTH, LossReason::Duplicate)]);
    let (holder, newcomer) = (claimant(BOTH, LATER), claimant(BOTH, ELDER));
    assert_eq!(world.at(1).others, [Output::Collision { node: node(BOTH), holder, newcomer }]);
}

// spec: NDL-5.7
#[test]
fn who_was_frozen_for_so_long_that_a_later_life_took_over_gives_up_when_it_goes_on() {
    let mut world = World::new();
    world.start(1, &Spec::of(1));
    world.start(ELDER, &Spec { incarnation: 1, ..Spec::of(BOTH) });
    world.run(PERIOD * 6);
    world.stall(ELDER, PERIOD * 20);
    world.run(PERIOD * 5);
    world.start(LATER, &Spec { incarnation: 2, ..Spec::of(BOTH) });
    // Who has not known the frozen one comes meanwhile.
    world.start(2, &Spec::of(2));
    world.run(PERIOD * 15 + ms(1));
    world.forget_the_past();
    world.run(PERIOD * 8);
    assert!(world.gave_up(ELDER) && !world.gave_up(LATER));
    assert_eq!((has(&world, 1), has(&world, 2)), (Some(Incarnation(2)), Some(Incarnation(2))));
    assert_eq!((world.losses(1), world.losses(2)), (vec![], vec![]), "nobody doubted the later life");
}

/// Both settle, and hear of each other for the first time when the elder's last period begins, while the later life has 77 ms more.
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
fn of_two_that_meet_when_the_elder_has_almost_settled_the_later_life_gives_up_alone() {
    let mut world = two_that_meet_in_the_last_period_of_settling();
    world.run(PERIOD * 8);
    assert!(world.gave_up(LATER) && !world.gave_up(ELDER));
    assert_eq!(world.at(ELDER).core.announcement().claim, Claim::Held);
}

// spec: NDL-5.5
#[test]
fn who_settles_gives_up_when_a_later_life_that_does_not_hear_it_has_settled_or_settles_without_end() {
    for is_endless in [false, true] {
        let mut world = two_that_meet_in_the_last_period_of_settling();
        let begin = world.now;
        while !world.gave_up(ELDER) {
            assert!(world.now.since(begin) <= PERIOD * 6, "it waits for ever");
            assert_eq!(world.at(ELDER).core.announcement().claim, Claim::Settling);
            // No answer finds its question any more: a datagram takes twice as long.
            world.run(world.flight / 2);
            let now = world.now;
            let later = &mut world.process(LATER).core;
            (later.contacts, later.group_questions) = Default::default();
            if is_endless {
                later.settle(now);
            }
        }
        assert!(!world.gave_up(LATER));
        let claim = if is_endless { Claim::Settling } else { Claim::Held };
        assert_eq!(world.at(LATER).core.announcement().claim, claim);
    }
}

// spec: NDL-5.7
#[test]
fn who_was_alone_and_meets_an_elder_life_that_makes_way_for_it_keeps_the_address() {
    // given: the later life has settled, and has lost everybody; the elder, whose clock was behind, comes into the last period of its settling
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
    // when: each asks the other in the same moment
    world.mend();
    parted.into_iter().for_each(|(one, other)| part(&mut world, one, other));
    world.run(ms(2));
    // then: the elder has heard that the other had settled
    assert!(world.gave_up(ELDER) && !world.gave_up(LATER));
    world.run(PERIOD * 8);
    assert!(!world.gave_up(LATER));
    assert_eq!(world.at(LATER).core.announcement().claim, Claim::Held);
}

#[test]
fn reports_of_addresses_used_twice_are_remembered_for_as_long_as_they_hold_others_back() {
    let mut world = World::of_members(2);
    for nodes in [10..40, 40..41] {
        let reported = nodes.clone().count();
        for address in nodes.clone().chain(nodes) {
            world.with(udp(1), |core, now| core.collide(now, node(address), claimant(2, 2), claimant(3, 3)));
        }
        assert_eq!(world.at(1).others.len(), reported, "each once");
        assert_eq!(world.at(1).core.collisions_reported.len(), reported);
        world.run(ms(10_000));
        world.forget_the_past();
    }
}

/// What is broken on purpose.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
enum Fault {
    /// An elder life never takes its address from a later one.
    KeepsWhomItMetFirst,
    /// Who has settled never gives up.
    NeverGivesUp,
    /// Who gives up does not say so.
    YieldsInSilence,
}

fn break_it(world: &mut World, fault: Option<Fault>) {
    for process in world.processes.values_mut() {
        match fault {
            Some(Fault::KeepsWhomItMetFirst) => {
                process.core.members.values_mut().for_each(|member| member.since = Time::MAX);
            }
            Some(Fault::NeverGivesUp) => process.core.trial = None,
            Some(Fault::YieldsInSilence) | None => {}
        }
    }
}

/// Random meetings of two processes with one address, and of others with them, in some of which those two never hear each other; what
/// is wrong at the end.
fn meet(seed: u64, fault: Option<Fault>) -> Result<(), String> {
    let mut chance = Chance::new(seed);
    let others = 1 + chance.index(OTHERS_MAX.into()) as u16;
    let mut world = World::new();
    world.loses_goodbyes = fault == Some(Fault::YieldsInSilence);
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
    // A settling, a trial, a loss, and the longest wait before a lost node's address is asked again.
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
fn whoever_meets_whom_first_all_end_with_the_same_one_of_two() {
    let (only, seeds) = (number(SEED_VARIABLE), number(SEEDS_VARIABLE).unwrap_or(SEEDS));
    for number in only.map_or(0..seeds, |only| only..only + 1) {
        let test = "ndl::core::tests::duplicates::whoever_meets_whom_first";
        let seed = Seed { number, variable: SEED_VARIABLE, package: "sinew", test };
        if let Err(words) = seed.run(|| meet(number, None)) {
            panic!("{words}\n{seed}");
        }
    }
    println!("{} seeds", only.map_or(seeds, |_| 1));
}

#[test]
fn each_rule_that_is_taken_away_is_missed() {
    for fault in [Fault::KeepsWhomItMetFirst, Fault::NeverGivesUp, Fault::YieldsInSilence] {
        let found = (0..SEEDS).find_map(|seed| Some((seed, meet(seed, Some(fault)).err()?)));
        let Some((seed, words)) = found else { panic!("{fault:?} is not found in {SEEDS} seeds") };
        println!("{fault:?}: seed {seed}: {words}");
    }
}
