//! Lets 8 processes with 64 addresses send each other messages of every class while they are killed at random, and says
//! what became of every one.
//!
//! `cargo run --release -p sinew-tests --bin conservation [OPTIONS]`; `--help` names them.
//!
//! Exit code 1: a message was lost in silence, double or out of order, or a confirmed one had no outcome or a false one.

use std::{process::ExitCode, time::Duration};

use clap::Parser;
use sinew_tests::clients::{
    conservation::{Plan, run},
    play,
};

/// Lets 8 processes with 64 addresses send each other messages while they are killed at random.
///
/// The environment variable SINEW_TEST_TRANSPORT chooses their way: `socket`, `ring` (default) or `direct`.
#[derive(Parser)]
struct Arguments {
    /// How many processes are killed.
    #[arg(long, default_value_t = 200)]
    kills: u32,
    /// From one kill to the next, in milliseconds.
    #[arg(long, default_value_t = 250)]
    spacing_ms: u64,
    /// An address's pause between two messages, in milliseconds.
    #[arg(long, default_value_t = 6)]
    pause_ms: u64,
    /// What all chance comes from; another one each time if it is not given.
    #[arg(long, default_value_t = u64::from(std::process::id()))]
    seed: u64,
}

fn main() -> ExitCode {
    if let Some(code) = play() {
        return code;
    }
    let Arguments { kills, spacing_ms, pause_ms, seed } = Arguments::parse();
    let report = run(Plan {
        program: std::env::current_exe().expect("a program has a path"),
        processes: 8,
        kills,
        spacing: Duration::from_millis(spacing_ms),
        pause: Duration::from_millis(pause_ms),
        seed,
    });
    println!("{report}");
    if report.holds() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
