//! Message conservation, in short: the long form is the program `conservation`.

use std::time::Duration;

use sinew_tests::clients::{
    conservation::{Plan, run},
    fate_tracker::Fate,
};

#[test]
fn each_message_has_one_true_outcome_despite_kills() {
    let seed = u64::from(std::process::id());
    let report = run(Plan {
        processes: 8,
        kills: 12,
        spacing: Duration::from_millis(200),
        pause: Duration::from_millis(40),
        seed,
    });
    println!("{report}");
    assert!(
        report.holds(),
        "replay with `conservation --seed {seed} --kills 12 --spacing-ms 200 --pause-ms 40`:\n{report}"
    );
    assert_eq!(report.account.killed, 12 * 8);
    assert!(report.account.of(Fate::LostWithDestination) > 0, "kills were felt:\n{report}");
}
