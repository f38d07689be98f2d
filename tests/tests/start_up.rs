//! Four nodes, each a process, that start in some of the orders, and are killed at some moments; all of them is what the program
//! `barriers` does.

use sinew_tests::{
    meetings::{Cast, PARTIES, permutations},
    program,
};

fn start_in(order: [usize; 4]) -> Cast {
    let mut cast = Cast::new();
    order.into_iter().for_each(|index| cast.start(&program("barriers"), index));
    cast.wait_until_passed(0);
    cast.wait_for_one_directory();
    cast
}

#[test]
fn nobody_starts_or_goes_on_early_in_whichever_order_the_nodes_start() {
    // The one that requires most first, and three more.
    for order in permutations().into_iter().rev().step_by(7) {
        let verdict = start_in(order).judge();
        assert!(verdict.violations.is_empty(), "{order:?}: {:?}", verdict.violations);
        assert!(verdict.generations > 0);
    }
}

#[test]
fn each_node_may_be_killed_and_the_others_meet_its_next_life() {
    let mut cast = start_in([0, 1, 2, 3]);
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
