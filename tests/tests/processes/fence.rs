//! Processes with fenced incarnations: no orphan, no late message, no forged number.

use std::fs;

use rustix::process::Signal;
use sinew_testkit::{NodeProcess, TestDirectory, until};
use sinew_tests::{orders::Order, process_under_test};

use super::scenario::{Scenario, configuration};

/// The ID of the process that writes this line.
fn process_of_line(node: &mut NodeProcess, words: &[&str]) -> u32 {
    let line = node.wait_for(words);
    line.split(' ').next().and_then(|pid| pid.parse().ok()).expect("each line begins with the process")
}

/// The thread `io` listens to the process, and may hang because of another application on it.
#[test]
fn no_process_outlives_its_turn_when_its_listener_hangs() {
    let directory = TestDirectory::new();
    let arguments = ["--neighbour-hangs", "0", "--stays"];
    let mut node = process_under_test(&configuration(&directory, ""), &arguments);
    let first = process_of_line(&mut node, &[" started "]);
    node.wait_for(&["hangs"]);
    let is_over = || (parent_of(first) != Some(node.id())).then_some(());
    until(&format!("process {first} has ended, while its node lives"), is_over);
    // Four threads are abandoned: one more than allowed. The output of the later ones depends on their
    // progress.
    node.wait_for(&["gave up"]);
    node.wait_for(&["node has ended"]);
    until("the program lives on, and none of its processes", || {
        children_of(node.id()).is_empty().then_some(())
    });
}

#[test]
fn late_messages_of_a_fenced_process_are_dropped() {
    let directory = TestDirectory::new();
    let arguments = ["--neighbour-hangs", "1000", "--talks"];
    let mut node = process_under_test(&configuration(&directory, ""), &arguments);
    let first = process_of_line(&mut node, &[" started "]);
    let second = process_of_line(&mut node, &[" started "]);
    node.wait_for(&[&format!("heard {second} ")]);
    node.wait_for(&["comes back"]);
    // It has the lowest priority now, and ends when it has dropped its values.
    until("the thread that was given up has ended", || (threads_called(node.id(), "io") == 1).then_some(()));
    node.signal(Signal::TERM);
    assert_eq!(node.wait_for_exit(), Some(0));
    let received: Vec<_> = node.output().iter().filter(|line| line.contains(" heard ")).collect();
    let since =
        received.iter().position(|line| line.contains(&format!("heard {second} "))).expect("it was heard");
    let late: Vec<_> =
        received[since..].iter().filter(|line| line.contains(&format!("heard {first} "))).collect();
    assert!(since > 0, "the first one was heard before it was taken");
    assert!(late.is_empty(), "{first} was heard after {second}: {late:?}");
}

#[test]
fn process_that_forges_message_numbers_is_killed() {
    let mut scenario = Scenario::start(&["--talks"]);
    scenario.order(Order::ForgeNumbers("witness".to_owned()));
    scenario.node.wait_for(&["a child failed", "it was killed: its message number", "is out of reach"]);
    let second = scenario.who().pid;
    let line = scenario.node.wait_for(&[&format!("heard {second} in ")]);
    let sequence = line.rsplit(' ').next().and_then(|number| number.parse::<u64>().ok());
    assert!(sequence.is_some_and(|sequence| sequence < 1 << 32), "{line}");
    let is_forged = |line: &String| line.contains("heard 0 in");
    assert!(!scenario.node.output().iter().any(is_forged), "what had a forged number was not heard");
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
    // The name in parentheses may contain any characters.
    let (_, rest) = stat.rsplit_once(')')?;
    rest.split_whitespace().nth(1)?.parse().ok()
}
