//! A consumer on another node that does not keep up, in short: the long form is the program `slow_consumer`.

use std::time::Duration;

use sinew_tests::slow_consumer::{Plan, run};

#[test]
fn slow_consumer_fills_neither_node_beyond_its_bound() {
    let plan = Plan {
        lasts: Duration::from_secs(3),
        rate: 2_000,
        length: 40_000,
        takes: Duration::from_millis(50),
        reference: Duration::from_millis(500),
    };
    let report = run(&plan);
    println!("{report}");
    assert!(report.is_bounded(), "{report}");
    assert!(report.taken > 0 && report.slow.count > 0, "{report}");
    // The load must exceed the capacity; otherwise the test shows nothing.
    let offered = report.offered * plan.length as u64;
    assert!(offered > report.bounds.iter().sum(), "{offered} bytes were offered:\n{report}");
}
