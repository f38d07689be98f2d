//! Processes that a node's process has started: they end with it.

use rustix::process::Signal;
use sinew::Outcome;
use sinew_tests::orders::Order;

use super::scenario::{Scenario, Watched, signal};

/// A process that the application has started.
fn sleeper(scenario: &mut Scenario, in_own_group: bool) -> Watched {
    scenario.order(Order::StartASleeper(in_own_group));
    let line = scenario.node.wait_for(&["sleeper"]);
    let id = line.rsplit(' ').next().and_then(|id| id.parse().ok()).expect("it ends with its id");
    let sleeper = Watched::new(id);
    assert!(sleeper.is_alive());
    sleeper
}

#[test]
fn descendants_end_with_their_process_however_it_ends() {
    let restarts = "[supervision]\napp_restarts_max = 1000\napp_window_ms = 1\n";
    let mut scenario = Scenario::start_with(restarts, &[]);
    for order in [Order::Kill, Order::Exit(0), Order::Panic, Order::Hang] {
        let sleeper = sleeper(&mut scenario, false);
        assert_eq!(scenario.order_confirmed(order), Outcome::Failed);
        sleeper.wait_for_end();
    }
    assert_eq!(scenario.count_confirmed(1), Outcome::Delivered);
}

#[test]
fn descendants_end_when_the_node_stops_in_order() {
    let mut scenario = Scenario::start(&[]);
    let sleeper = sleeper(&mut scenario, false);
    scenario.node.signal(Signal::TERM);
    assert_eq!(scenario.node.wait_for_exit(), Some(0));
    sleeper.wait_for_end();
}

#[test]
fn descendants_in_another_group_are_left_alone() {
    let mut scenario = Scenario::start(&[]);
    let pid = scenario.who().pid;
    let (ours, other) = (sleeper(&mut scenario, false), sleeper(&mut scenario, true));
    signal(pid, Signal::KILL);
    ours.wait_for_end();
    assert_ne!(scenario.who().pid, pid);
    assert!(other.is_alive());
    other.kill();
}
