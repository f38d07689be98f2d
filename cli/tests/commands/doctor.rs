//! Findings of `sinew doctor` about the host system.

use std::process::Command;

use sinew_testkit::{
    NodeProcess,
    sandbox::{PIDFD_OPEN, without_system_call},
};

#[test]
fn unwatchable_own_processes_are_a_finding() {
    let sinew = Command::new(env!("CARGO_BIN_EXE_sinew"));
    let Some(mut command) = without_system_call(PIDFD_OPEN, &sinew) else { return };
    command.arg("doctor");
    let mut doctor = NodeProcess::start("doctor", command);
    assert_ne!(doctor.wait_for_exit(), Some(0));
    let finds =
        |words: &[&str]| doctor.output().iter().any(|line| words.iter().all(|word| line.contains(word)));
    assert!(finds(&["own processes", "FINDING", "pidfd_open"]), "{:#?}", doctor.output());
    assert!(finds(&["own processes:", "Linux 5.4"]), "{:#?}", doctor.output());
}
