//! Four nodes, each a process, that start in some of the orders, and are killed at some moments. The program
//! `barriers` runs all of them.

use sinew_tests::barriers::{PARTIES, Scenario, permutations};

#[test]
fn no_start_order_opens_the_barrier_early() {
    // The order that starts with the most requirements, and three more.
    for order in permutations().into_iter().rev().step_by(7) {
        let verdict = Scenario::one_by_one(order).judge();
        assert!(verdict.violations.is_empty(), "{order:?}: {:?}", verdict.violations);
        assert!(verdict.generations > 0);
    }
}

#[test]
fn simultaneous_start_opens_no_barrier_early() {
    let verdict = Scenario::at_once().judge();
    assert!(verdict.violations.is_empty(), "{:?}", verdict.violations);
    assert!(verdict.generations > 0);
}

#[test]
fn killed_node_is_replaced_and_met_by_the_others() {
    let mut scenario = Scenario::at_once();
    for killed in 0..PARTIES.len() {
        scenario.kill(killed);
        let generation = scenario.generation();
        scenario.start(killed);
        scenario.wait_until_passed(generation + 1);
    }
    scenario.wait_for_one_directory();
    let verdict = scenario.judge();
    assert!(verdict.violations.is_empty(), "{:?}", verdict.violations);
}

#[test]
fn node_killed_while_waiting_does_not_count_later() {
    let mut scenario = Scenario::at_once();
    for killed in 0..PARTIES.len() {
        scenario.kill_who_waits(killed, (killed + 1) % PARTIES.len());
    }
    let verdict = scenario.judge();
    assert!(verdict.violations.is_empty(), "{:?}", verdict.violations);
}
