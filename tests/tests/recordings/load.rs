//! Ten channels under load: the short form of the scenario `recording`.

use std::time::Duration;

use sinew_tests::recording::{Load, Plan, run};

#[test]
fn ten_loaded_channels_are_accounted_for() {
    // 100,000 messages per second in all, which a debug build may not reach.
    let load = Load { rate: 10_000, length: 64, count: 10_000 };
    let report = run(&Plan { sources: 10, load, rounds: 1, write_takes: Duration::ZERO, keep_bytes: None });
    assert!(report.holds(), "{report}");
    assert!(report.rounds.iter().all(|round| round.with.total() > 0), "{report}");
}
