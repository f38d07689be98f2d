//! Four nodes, each a process, that start in some of the orders, and are killed at some moments; all of them is what the program
//! `barriers` does.

use sinew_tests::{
    meetings::{Cast, PARTIES, permutations},
    program,
};

#[test]
fn nobody_starts_or_goes_on_early_in_whichever_order_the_nodes_start() {
    // The one that requires most first, and three more.
    for order in permutations().into_iter().rev().step_by(7) {
        let verdict = Cast::one_by_one(&program("barriers"), order).judge();
        assert!(verdict.violations.is_empty(), "{order:?}: {:?}", verdict.violations);
        assert!(verdict.generations > 0);
    }
}

#[test]
fn nobody_starts_or_goes_on_early_when_all_nodes_start_at_once() {
    let verdict = Cast::at_once(&program("barriers")).judge();
    assert!(verdict.violations.is_empty(), "{:?}", verdict.violations);
    assert!(verdict.generations > 0);
}

#[test]
fn each_node_may_be_killed_and_the_others_meet_its_next_life() {
    let mut cast = Cast::at_once(&program("barriers"));
    for killed in 0..PARTIES.len() {
        cast.kill(killed);
        let generation = cast.generation();
        cast.start(&program("barriers"), killed);
        cast.wait_until_passed(generation + 1);
    }
    cast.wait_for_one_directory();
    let verdict = cast.judge();
    assert!(verdict.violations.is_empty(), "{:?}", verdict.violations);
}

#[test]
fn who_is_killed_while_it_waits_does_not_count_for_who_comes_later() {
    let mut cast = Cast::at_once(&program("barriers"));
    for killed in 0..PARTIES.len() {
        cast.kill_who_waits(&program("barriers"), killed, (killed + 1) % PARTIES.len());
    }
    let verdict = cast.judge();
    assert!(verdict.violations.is_empty(), "{:?}", verdict.violations);
}
