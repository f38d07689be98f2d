//! Hostile clients, in short: the long form is the program `hostile_client`.

use std::time::Duration;

use sinew_tests::{
    clients::hostile::{Plan, run},
    program,
};

#[test]
fn a_node_lives_within_its_bounds_and_serves_the_others_whatever_a_client_does() {
    let seed = u64::from(std::process::id());
    let report = run(Plan { program: program("hostile_client"), lasts: Duration::from_secs(5), seed });
    println!("{report}");
    assert!(report.holds(), "replay with `--bin hostile_client -- --seed {seed}`:\n{report}");
}
