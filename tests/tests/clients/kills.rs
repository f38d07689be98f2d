//! Processes that are killed while they hold loans, in short. The long form is the program `client_kills`.

use std::time::Duration;

use sinew_tests::clients::kills::{Plan, run};

#[test]
fn killed_loan_holders_leave_nothing_behind() {
    let report = run(Plan {
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
