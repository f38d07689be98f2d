//! Kills processes at random instants, under load, while they hold loans, and says what the others hold after it, how long
//! their messages took, and what is left in the file system.
//!
//! `cargo run --release -p sinew-tests --bin client_kills [--kills N] [--spacing-ms N] [--reference-ms N] [--seed N]`
//!
//! Exit code 1: something was not given back, a file was left, or a message of others was lost.

use std::{process::ExitCode, time::Duration};

use sinew_tests::clients::{
    kills::{Plan, run},
    play,
};

fn main() -> ExitCode {
    if let Some(code) = play() {
        return code;
    }
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let number = |flag: &str, otherwise: u64| {
        let after = arguments.iter().skip_while(|argument| *argument != flag).nth(1);
        after.map_or(otherwise, |value| value.parse().unwrap_or_else(|_| panic!("{flag} takes a number")))
    };
    let seed = number("--seed", u64::from(std::process::id()));
    println!("seed {seed}");
    let report = run(Plan {
        program: std::env::current_exe().expect("a program has a path"),
        kills: u32::try_from(number("--kills", 1_000)).expect("not that many"),
        spacing: Duration::from_millis(number("--spacing-ms", 40)),
        reference: Duration::from_millis(number("--reference-ms", 10_000)),
        seed,
    });
    println!("{report}");
    if report.holds() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
