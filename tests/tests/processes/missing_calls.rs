//! A kernel, or a seccomp filter, without a system call that a process of its own needs.

use std::process::Command;

use sinew_tests::{
    OwnDirectory, Program, program,
    sandbox::{PIDFD_OPEN, without_system_call},
};

use crate::scenario::configuration;

fn node_without_pidfd_open() -> Option<Command> {
    without_system_call(PIDFD_OPEN, &program("process_under_test"))
}

#[test]
fn a_node_whose_processes_cannot_be_watched_does_not_start_and_says_what_is_missing() {
    let directory = OwnDirectory::new();
    let Some(mut command) = node_without_pidfd_open() else { return };
    command.arg(configuration(&directory, ""));
    let mut node = Program::start("robot", command);
    let code = node.wait_for_end();
    assert_eq!(code, Some(1), "{:#?}", node.said());
    let errors: Vec<_> = node.said().iter().filter(|line| line.contains("pidfd_open")).collect();
    assert_eq!(errors.len(), 1, "{:#?}", node.said());
    for words in ["own_process", "Linux 5.3", "seccomp"] {
        assert!(errors[0].contains(words), "{words}: {errors:?}");
    }
    assert!(!node.said().iter().any(|line| line.contains("ulimit")), "{:#?}", node.said());
}

#[test]
fn a_node_without_own_processes_starts_although_none_could_be_watched() {
    let directory = OwnDirectory::new();
    let Some(mut command) = node_without_pidfd_open() else { return };
    command.arg(configuration(&directory, "")).args(["--place", "thread"]);
    Program::start("robot", command).wait_for(&["is up"]);
}
