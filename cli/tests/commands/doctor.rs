//! What `sinew doctor` says of the system that it runs on.

use std::path::Path;

use sinew_tests::{
    Program,
    sandbox::{PIDFD_OPEN, without_system_call},
};

#[test]
fn doctor_finds_that_own_processes_cannot_be_watched() {
    let sinew = Path::new(env!("CARGO_BIN_EXE_sinew"));
    let Some(mut command) = without_system_call(PIDFD_OPEN, sinew) else { return };
    command.arg("doctor");
    let mut doctor = Program::start("doctor", command);
    assert_ne!(doctor.wait_for_end(), Some(0));
    let finds =
        |words: &[&str]| doctor.said().iter().any(|line| words.iter().all(|word| line.contains(word)));
    assert!(finds(&["own processes", "FINDING", "pidfd_open"]), "{:#?}", doctor.said());
    assert!(finds(&["own processes:", "Linux 5.4"]), "{:#?}", doctor.said());
}
