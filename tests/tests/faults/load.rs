//! Layers that die under load, in short: the long form is the program `layer_panics`.

use std::time::Duration;

use sinew_tests::{
    load::{Plan, run},
    program,
};

#[test]
fn forty_layer_panics_under_load_lose_nothing_within_a_node_and_nothing_between_nodes() {
    let plan =
        Plan { panics: 40, in_process: 5_000, between_nodes: 5_000, spacing: Duration::from_millis(15) };
    let report = run(plan);
    assert!(report.in_process.is_perfect(), "{report}");
    assert!(report.in_process.confirmed > 0, "{report}");
    assert!(report.between_nodes.is_perfect(), "{report}");
    assert!(report.between_nodes.confirmed > 0, "{report}");
    assert_eq!(report.restarted, 0, "{report}");
}

/// In a process of its own: what other tests of this one hold would be counted as well.
#[test]
fn three_hundred_restarts_keep_no_memory_no_descriptor_and_no_thread() {
    let mut growth = std::process::Command::new(program("growth"));
    // Whoever looks up a backtrace keeps what he has read of the program for the next one.
    growth.args(["--restarts", "300"]).env("RUST_BACKTRACE", "0");
    let output = growth.output().expect("it is built with the tests");
    assert!(output.status.success(), "{output:?}");
}
