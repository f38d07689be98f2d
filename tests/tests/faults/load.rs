//! Layers that die under load, in short: the long form is the program `layer_panics`.

use std::time::Duration;

use sinew_testkit::program;
use sinew_tests::load::{Plan, run};

#[test]
fn forty_layer_panics_under_load_lose_no_message() {
    let plan =
        Plan { panics: 40, in_process: 5_000, between_nodes: 5_000, spacing: Duration::from_millis(15) };
    let report = run(plan);
    assert!(report.in_process.is_perfect(), "{report}");
    assert!(report.in_process.asked > 0, "{report}");
    assert!(report.between_nodes.is_perfect(), "{report}");
    assert!(report.between_nodes.asked > 0, "{report}");
    assert_eq!(report.restarted, 0, "{report}");
}

/// In a process of its own: resources of other tests in this process would be counted as well.
#[test]
fn three_hundred_restarts_leak_no_resource() {
    let mut growth = std::process::Command::new(program("scenarios"));
    // A backtrace lookup caches the parts of the program that it has read.
    growth.args(["growth", "--restarts", "300"]).env("RUST_BACKTRACE", "0");
    let output = growth.output().expect("it is built with the tests");
    assert!(output.status.success(), "{output:?}");
}
