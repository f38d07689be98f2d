//! Attacks on a secured robot, in short. The long form is the program `attacks`, which also measures times.

use std::{io::Write as _, time::Duration};

use sinew_tests::attacks::{Plan, run};

/// All attacks of the program: those from the network, and those from its own host.
const OF_THE_NETWORK: [&str; 8] = [
    "wrong-authority",
    "no-certificate",
    "stolen-certificate",
    "datagrams",
    "forged-sources",
    "connections",
    "handshakes",
    "slow-loris",
];
const OF_THE_HOST: [&str; 7] = [
    "garbage",
    "local-client",
    "guest-groups",
    "guest-memberships",
    "guest-barriers",
    "guest-connections",
    "descriptors",
];

#[test]
fn network_attacks_are_held_off() {
    is_held_off(&OF_THE_NETWORK);
}

#[test]
fn local_attacks_are_held_off() {
    is_held_off(&OF_THE_HOST);
}

fn is_held_off(attacks: &[&str]) {
    let report = run(&Plan {
        lasts: Duration::from_secs(1),
        timed: Duration::from_millis(500),
        rounds: 1,
        only: attacks.iter().map(|attack| (*attack).to_owned()).collect(),
    });
    match report {
        Ok(report) => {
            println!("{report}");
            assert!(report.has_held(), "an attack was not held off:\n{report}");
        }
        // Writes directly to the standard error, because the output of a passing test is captured. Otherwise
        // a run without hosts would look like a robot that resisted the attacks.
        Err(why) => {
            let line = format!("\nUNTESTED, no attack was tried: no hosts can be made here: {why}\n");
            std::io::stderr().write_all(line.as_bytes()).expect("standard error is open");
        }
    }
}
