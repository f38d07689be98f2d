//! Every way in which a process ends or hangs, without an orphan.

use std::{fs, time::Duration};

use rustix::process::Signal;
use sinew::Outcome;
use sinew_testkit::{TestDirectory, until, wait_until_paused};
use sinew_tests::{orders::Order, process_under_test};

use super::fence::parent_of;
use super::scenario::{Scenario, Watched, configuration, signal};

/// Its applications may be restarted as often as they fail.
const RESTARTS: &str = "[supervision]\napp_restarts_max = 1000\napp_window_ms = 1\n";

#[test]
fn app_in_own_process_answers_from_there() {
    let mut scenario = Scenario::start(&[]);
    let me = scenario.who();
    assert_ne!(me.pid, scenario.node.id());
    let thread = Scenario::start(&["--place", "thread"]).who();
    assert_ne!(thread.pid, me.pid);
}

#[test]
fn killed_process_is_replaced_and_queue_keeps_order() {
    let mut scenario = Scenario::start(&[]);
    let first = scenario.who();
    scenario.order(Order::Hold(60_000));
    scenario.node.wait_for(&["holds"]);
    (1..=200).for_each(|number| scenario.count(number));
    signal(first.pid, Signal::KILL);
    assert_eq!(scenario.count_confirmed(201), Outcome::Delivered);
    let second = scenario.who();
    assert_ne!(second.pid, first.pid);
    assert_eq!(second.counts, (1..=201).collect::<Vec<_>>());
    scenario.node.wait_for(&["a child failed", "killed by signal 9 (SIGKILL)"]);
}

#[test]
fn audit_knows_lent_and_failed_messages_of_a_process() {
    let mut scenario = Scenario::start(&["--audits"]);
    let first = scenario.who();
    scenario.order(Order::Hold(60_000));
    scenario.node.wait_for(&["holds"]);
    (1..=20).for_each(|number| scenario.count(number));
    // The order that it handles, and those behind it, in whichever queue they wait.
    scenario.node.wait_for(&["audit: 1 delivered, 0 failed, 21 waiting, 0 unexplained"]);
    signal(first.pid, Signal::KILL);
    scenario.node.wait_for(&["audit: 21 delivered, 1 failed, 0 waiting, 0 unexplained"]);
}

#[test]
fn every_death_is_named_and_fails_the_handled_message() {
    let deaths = [
        (Order::Exit(3), "its process ended: exit code 3"),
        (Order::Abort, "killed by signal 6 (SIGABRT)"),
        (Order::OverflowTheStack, "killed by signal 6 (SIGABRT)"),
        (Order::Kill, "killed by signal 9 (SIGKILL)"),
        (Order::Segfault, "killed by signal 11 (SIGSEGV)"),
    ];
    let mut scenario = Scenario::start_with(RESTARTS, &[]);
    for (order, words) in deaths {
        let process = Watched::new(scenario.who().pid);
        assert_eq!(scenario.order_confirmed(order), Outcome::Failed);
        process.wait_for_end();
        scenario.node.wait_for(&["a child failed", words]);
    }
    assert_eq!(scenario.count_confirmed(1), Outcome::Delivered);
}

#[test]
fn endless_handler_is_killed_and_replaced() {
    let mut scenario = Scenario::start(&[]);
    let process = Watched::new(scenario.who().pid);
    assert_eq!(scenario.order_confirmed(Order::Hang), Outcome::Failed);
    process.wait_for_end();
    scenario.node.wait_for(&["a child failed", "hung: in its handler of `process.order` has not come back"]);
    assert_eq!(scenario.count_confirmed(1), Outcome::Delivered);
}

#[test]
fn stopped_process_is_killed_and_replaced() {
    let mut scenario = Scenario::start(&[]);
    let pid = scenario.who().pid;
    let process = Watched::new(pid);
    signal(pid, Signal::STOP);
    process.wait_for_end();
    scenario.node.wait_for(&["a child failed", "hung: no sign of life"]);
    assert_ne!(scenario.who().pid, pid);
}

#[test]
fn busy_process_is_left_alone() {
    let mut scenario = Scenario::start(&["--turns-within", "2000"]);
    let pid = scenario.who().pid;
    // Twice its progress budget in all, and no single turn above it.
    (0..20).for_each(|_| scenario.order(Order::Hold(200)));
    assert_eq!(scenario.who().pid, pid);
}

#[test]
fn resumed_node_does_not_accuse_its_processes() {
    let mut scenario = Scenario::start(&[]);
    let pid = scenario.who().pid;
    for _ in 0..3 {
        scenario.node.pause();
        // Longer than the progress budget of the application.
        std::thread::sleep(Duration::from_millis(1_500));
        scenario.node.signal(Signal::CONT);
        assert_eq!(scenario.count_confirmed(1), Outcome::Delivered);
    }
    assert_eq!(scenario.who().pid, pid);
}

#[test]
fn process_dies_with_its_node() {
    let busy = [None, Some(Order::Hold(60_000)), Some(Order::Hang)];
    for order in busy {
        let mut scenario = Scenario::start(&[]);
        let process = Watched::new(scenario.who().pid);
        order.into_iter().for_each(|order| scenario.order(order));
        scenario.node.signal(Signal::KILL);
        process.wait_for_end();
    }
}

#[test]
fn stopped_process_dies_with_its_node() {
    let mut scenario = Scenario::start(&[]);
    let pid = scenario.who().pid;
    let process = Watched::new(pid);
    signal(pid, Signal::STOP);
    wait_until_paused(pid);
    scenario.node.signal(Signal::KILL);
    process.wait_for_end();
}

#[test]
fn process_that_exceeds_its_stop_limit_is_killed() {
    // Its turn may last: only the stop limit applies.
    let mut scenario = Scenario::start(&["--turns-within", "600000"]);
    let process = Watched::new(scenario.who().pid);
    scenario.order(Order::Hold(60_000));
    scenario.node.wait_for(&["holds"]);
    scenario.node.signal(Signal::TERM);
    scenario.node.wait_for(&["the incarnation is abandoned"]);
    process.wait_for_end();
    assert_eq!(scenario.node.wait_for_exit(), Some(0));
}

#[test]
fn death_at_each_start_ends_the_node_with_reason() {
    let directory = TestDirectory::new();
    // However long each start takes.
    let window = "[supervision]\napp_window_ms = 3600000\n";
    let mut node = process_under_test(&configuration(&directory, window), &["--dies-at-start", "3"]);
    node.wait_for(&["gave up", "applications: more than 5 restarts", "its process ended: exit code 3"]);
    assert_eq!(node.wait_for_exit(), Some(1));
}

#[test]
fn next_process_waits_for_the_end_of_the_killed() {
    let directory = TestDirectory::new();
    // Each process is never ready, is killed when its time is over, and has half a gibibyte to free. On a
    // busy host some are killed before they report anything: the test continues until three have reported.
    let configuration = configuration(&directory, RESTARTS);
    let mut node = process_under_test(&configuration, &["--swells-at-start", "512"]);
    for _ in 0..3 {
        let line = node.wait_for(&["process has these brothers"]);
        assert!(line.ends_with("brothers: []"), "its devices and ports may be in use: {line}");
    }
}

#[test]
fn command_started_by_the_app_is_no_host() {
    let mut scenario = Scenario::start(&[]);
    scenario.order(Order::StartACommand);
    scenario.node.wait_for(&["command Ok(ExitStatus(unix_wait_status(0)))"]);
    assert_eq!(scenario.count_confirmed(1), Outcome::Delivered);
}

#[test]
fn two_hundred_deaths_leave_nothing_behind() {
    let mut scenario = Scenario::start_with(RESTARTS, &[]);
    let node = scenario.node.id();
    let die = |scenario: &mut Scenario| {
        let pid = scenario.who().pid;
        let process = Watched::new(pid);
        signal(pid, Signal::KILL);
        process.wait_for_end();
        pid
    };
    // The first ones create lasting resources: threads, their stacks and descriptors.
    for _ in 0..5 {
        die(&mut scenario);
    }
    scenario.who();
    let before = descriptors(node);
    let pids: Vec<_> = (0..200).map(|_| die(&mut scenario)).collect();
    scenario.who();
    // The drop of the last one may still be pending.
    until(&format!("{before} descriptors are left"), || (descriptors(node) <= before).then_some(()));
    let is_left = |pid: &u32| parent_of(*pid) == Some(node);
    until("no zombies are left", || (!pids.iter().any(is_left)).then_some(()));
}

fn descriptors(process: u32) -> usize {
    fs::read_dir(format!("/proc/{process}/fd")).expect("it lives").count()
}
