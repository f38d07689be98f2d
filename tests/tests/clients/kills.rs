//! Processes that are killed with loans in their hands, in short: the long form is the program `client_kills`.

use std::time::Duration;

use sinew_tests::{
    clients::kills::{Plan, run},
    program,
};

#[test]
fn twenty_killed_processes_that_held_loans_leave_nothing_behind() {
    let report = run(Plan {
        program: program("client_kills"),
        kills: 20,
        spacing: Duration::from_millis(40),
        reference_each: 1,
        seed: u64::from(std::process::id()),
        yields: false,
    });
    println!("{report}");
    assert!(report.holds(), "{report}");
    assert!(report.held_loans > 0, "some held loans when they were killed:\n{report}");
}
