//! Lets 8 processes with 64 addresses send each other messages of every class while they are killed at random, and says
//! what became of every one.
//!
//! `cargo run --release -p sinew-tests --bin conservation [--kills N] [--spacing-ms N] [--pause-ms N] [--seed N]`
//!
//! Exit code 1: a message was lost in silence, double or out of order, or a confirmed one had no outcome or a false one.

use std::{process::ExitCode, time::Duration};

use sinew_tests::clients::{
    conservation::{Plan, run},
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
    let report = run(Plan {
        program: std::env::current_exe().expect("a program has a path"),
        processes: 8,
        kills: u32::try_from(number("--kills", 200)).expect("not that many"),
        spacing: Duration::from_millis(number("--spacing-ms", 250)),
        pause: Duration::from_millis(number("--pause-ms", 6)),
        seed: number("--seed", u64::from(std::process::id())),
    });
    println!("{report}");
    if report.holds() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
