//! Message conservation, in short: the long form is the program `conservation`.

use std::time::Duration;

use sinew_tests::{
    clients::{
        conservation::{Plan, run},
        ledger::Fate,
    },
    program,
};

#[test]
fn whoever_is_killed_every_message_of_64_addresses_has_one_fate_that_is_true() {
    let seed = u64::from(std::process::id());
    let report = run(Plan {
        program: program("conservation"),
        processes: 8,
        kills: 12,
        spacing: Duration::from_millis(200),
        pause: Duration::from_millis(40),
        seed,
    });
    println!("{report}");
    assert!(
        report.holds(),
        "replay with `--bin conservation -- --seed {seed} --kills 12 --spacing-ms 200 --pause-ms 40`:\n{report}"
    );
    assert_eq!(report.account.killed, 12 * 8);
    assert!(report.account.of(Fate::LostWithDestination) > 0, "kills were felt:\n{report}");
}
