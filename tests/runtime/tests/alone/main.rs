//! Tests that need a process of their own: each runs in this program, started once more for it alone. They count
//! its allocations, install its subscriber or panic hook, or look at a thread that exists once in a process.

#![expect(clippy::unwrap_used, reason = "a test says what failed by failing")]

mod allocations;
mod backtraces;
mod deadlines;
mod events;
mod log;
#[cfg(target_os = "linux")]
mod log_cpus;
mod reader;
#[cfg(target_os = "linux")]
mod safe_output;

use std::process::{Command, Output};

/// Set in the process of a single test.
const ALONE: &str = "SINEW_TEST_ALONE";

/// Whether this process was started for one test.
fn is_alone() -> bool {
    std::env::var_os(ALONE).is_some()
}

/// Runs this program for one test, with these variables set.
fn run_alone(test: &str, variables: &[(&str, &str)]) -> Output {
    let mut program = Command::new(std::env::current_exe().unwrap());
    program.args([test, "--exact", "--nocapture"]).env_remove("RUST_LOG").env_remove("SINEW_LOG");
    program.env_remove("RUST_BACKTRACE").env(ALONE, "1").envs(variables.iter().copied());
    let output = program.output().unwrap();
    assert!(output.status.success(), "{output:#?}");
    let report = String::from_utf8_lossy(&output.stdout);
    assert!(report.contains("1 passed"), "there is no test {test}: {report}");
    output
}

/// Runs the body in a process of its own. `test` is the name of the calling test with its modules.
fn alone(test: &str, body: impl FnOnce()) {
    if is_alone() {
        body();
    } else {
        run_alone(test, &[]);
    }
}
