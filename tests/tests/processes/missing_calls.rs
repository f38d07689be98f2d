//! A kernel, or a seccomp filter, without a system call that an application in its own process needs.

use sinew_tests::role;
use std::process::Command;

use sinew_testkit::{
    NodeProcess, TestDirectory,
    sandbox::{PIDFD_OPEN, without_system_call},
};

use super::scenario::configuration;

fn node_without_pidfd_open() -> Option<Command> {
    without_system_call(PIDFD_OPEN, &role("process_under_test"))
}

#[test]
fn node_that_cannot_watch_its_processes_does_not_start() {
    let directory = TestDirectory::new();
    let Some(mut command) = node_without_pidfd_open() else { return };
    command.arg(configuration(&directory, ""));
    let mut node = NodeProcess::start("robot", command);
    let code = node.wait_for_exit();
    assert_eq!(code, Some(1), "{:#?}", node.output());
    let errors: Vec<_> = node.output().iter().filter(|line| line.contains("pidfd_open")).collect();
    assert_eq!(errors.len(), 1, "{:#?}", node.output());
    for words in ["own_process", "Linux 5.3", "seccomp"] {
        assert!(errors[0].contains(words), "{words}: {errors:?}");
    }
    assert!(!node.output().iter().any(|line| line.contains("ulimit")), "{:#?}", node.output());
}

#[test]
fn node_without_own_processes_starts_without_those_calls() {
    let directory = TestDirectory::new();
    let Some(mut command) = node_without_pidfd_open() else { return };
    command.arg(configuration(&directory, "")).args(["--place", "thread"]);
    NodeProcess::start("robot", command).wait_for(&["is up"]);
}
