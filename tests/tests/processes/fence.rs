//! Processes whose lives were taken: no orphan, no late word, no forged number.

use std::fs;

use rustix::process::Signal;
use sinew_tests::{OwnDirectory, Program, orders::Order, process_under_test, until};

use crate::scenario::{Scenario, configuration};

/// The number of the process that says this.
fn who_says(node: &mut Program, words: &[&str]) -> u32 {
    let line = node.wait_for(words);
    line.split(' ').next().and_then(|pid| pid.parse().ok()).expect("each line begins with the process")
}

/// Whoever listens to a process is on the `io` thread, which may hang on somebody else's account.
#[test]
fn no_process_outlives_its_turn_when_the_thread_that_listens_to_it_hangs_again_and_again() {
    let directory = OwnDirectory::new();
    let arguments = ["--neighbour-hangs", "0", "--stays"];
    let mut node = process_under_test(&configuration(&directory, ""), &arguments);
    let first = who_says(&mut node, &[" started "]);
    node.wait_for(&["hangs"]);
    let is_over = || (parent_of(first) != Some(node.id())).then_some(());
    until(&format!("process {first} has ended, while its node lives"), is_over);
    // Four threads are given up: one more than may be. What the later ones say depends on how far they come.
    node.wait_for(&["gave up"]);
    node.wait_for(&["node has ended"]);
    until("the program lives on, and none of its processes", || {
        children_of(node.id()).is_empty().then_some(())
    });
}

#[test]
fn late_words_of_a_process_whose_life_was_taken_do_not_come_between_its_successors() {
    let directory = OwnDirectory::new();
    let arguments = ["--neighbour-hangs", "1000", "--talks"];
    let mut node = process_under_test(&configuration(&directory, ""), &arguments);
    let first = who_says(&mut node, &[" started "]);
    let second = who_says(&mut node, &[" started "]);
    node.wait_for(&[&format!("heard {second} ")]);
    node.wait_for(&["comes back"]);
    // It has the lowest priority now, and ends when it has dropped what it held.
    until("the thread that was given up has ended", || (threads_called(node.id(), "io") == 1).then_some(()));
    node.signal(Signal::TERM);
    assert_eq!(node.wait_for_end(), Some(0));
    let heard: Vec<_> = node.said().iter().filter(|line| line.contains(" heard ")).collect();
    let since =
        heard.iter().position(|line| line.contains(&format!("heard {second} "))).expect("it was heard");
    let late: Vec<_> =
        heard[since..].iter().filter(|line| line.contains(&format!("heard {first} "))).collect();
    assert!(since > 0, "the first one was heard before it was taken");
    assert!(late.is_empty(), "{first} was heard after {second}: {late:?}");
}

#[test]
fn a_process_that_forges_the_number_of_a_message_is_ended_in_words_and_nobody_counts_on_from_there() {
    let mut scenario = Scenario::start(&["--talks"]);
    scenario.order(Order::ForgeNumbers("witness".to_owned()));
    scenario.node.wait_for(&["a child failed", "it was killed: its message number", "is out of reach"]);
    let second = scenario.who().pid;
    let line = scenario.node.wait_for(&[&format!("heard {second} in ")]);
    let sequence = line.rsplit(' ').next().and_then(|number| number.parse::<u64>().ok());
    assert!(sequence.is_some_and(|sequence| sequence < 1 << 32), "{line}");
    let is_forged = |line: &String| line.contains("heard 0 in");
    assert!(!scenario.node.said().iter().any(is_forged), "what had a forged number was not heard");
}

fn threads_called(process: u32, name: &str) -> usize {
    let tasks = fs::read_dir(format!("/proc/{process}/task")).expect("it lives").flatten();
    let names = tasks.filter_map(|task| fs::read_to_string(task.path().join("comm")).ok());
    names.filter(|found| found.trim_end() == name).count()
}

/// Children that are in the kernel's table, alive or not.
fn children_of(process: u32) -> Vec<u32> {
    let all = fs::read_dir("/proc").expect("it is there").flatten();
    let ids = all.filter_map(|entry| entry.file_name().to_str()?.parse::<u32>().ok());
    ids.filter(|id| parent_of(*id) == Some(process)).collect()
}

/// The parent of a process that is in the kernel's table, alive or not.
pub(crate) fn parent_of(process: u32) -> Option<u32> {
    let stat = fs::read_to_string(format!("/proc/{process}/stat")).ok()?;
    // The name in parentheses may have anything in it.
    let (_, rest) = stat.rsplit_once(')')?;
    rest.split_whitespace().nth(1)?.parse().ok()
}
