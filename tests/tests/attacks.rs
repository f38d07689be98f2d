//! Attacks on a secured robot, in short: the long form is the program `attacks`, which looks at times, too.

use std::{io::Write as _, time::Duration};

use sinew_tests::{
    attacks::{Plan, run},
    program,
};

/// All that the program has.
const PLAYED: [&str; 15] = [
    "wrong-authority",
    "no-certificate",
    "stolen-certificate",
    "datagrams",
    "forged-sources",
    "connections",
    "handshakes",
    "slow-loris",
    "garbage",
    "local-client",
    "guest-groups",
    "guest-memberships",
    "guest-barriers",
    "guest-connections",
    "descriptors",
];

#[test]
fn nobody_gets_in_is_lost_or_fills_memory_whatever_somebody_on_the_network_does() {
    let report = run(&Plan {
        program: program("attacks"),
        lasts: Duration::from_secs(1),
        timed: Duration::from_millis(500),
        rounds: 1,
        only: PLAYED.map(str::to_owned).into(),
    });
    match report {
        Ok(report) => {
            println!("{report}");
            assert!(report.has_held(), "an attack was not held off:\n{report}");
        }
        // Past what keeps the words of a test that passes: nobody shall take this for a robot that held.
        Err(why) => {
            let told = format!("\nUNTESTED, no attack was tried: no hosts can be made here: {why}\n");
            std::io::stderr().write_all(told.as_bytes()).expect("standard error is open");
        }
    }
}
