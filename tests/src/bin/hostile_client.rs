//! Lets hostile clients do to a node what they like, and says what it held, how others were served, and what it refused.
//!
//! `cargo run --release -p sinew-tests --bin hostile_client [--minutes N] [--seconds N] [--seed N]`
//!
//! Exit code 1: the node went beyond its bound, gave something not back, did not serve the others, or refused in silence.

use std::{process::ExitCode, time::Duration};

use sinew_tests::clients::{
    hostile::{Plan, run},
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
        lasts: Duration::from_secs(number("--minutes", 0) * 60 + number("--seconds", 0).max(5)),
        seed,
    });
    println!("{report}");
    if report.holds() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
