//! Lets 8 processes with 64 addresses send each other messages of every class while they are killed at
//! random, and reports the fate of every message.
//!
//! `cargo run --release -p sinew-tests -- conservation [OPTIONS]`.
//!
//! Exit code 1: a message was lost silently, duplicated or reordered, or a confirmed message had no outcome
//! or a false one.

use std::{process::ExitCode, time::Duration};

use clap::Args;
use sinew_testkit::options::Seed;
use sinew_tests::clients::conservation::{Plan, run};

/// Lets 8 processes with 64 addresses send each other messages while they are killed at random.
///
/// The environment variable SINEW_TEST_TRANSPORT selects the transport: `socket`, `ring` (all through the node),
/// `direct` or `automatic` (default).
#[derive(Args)]
pub(super) struct Arguments {
    /// Number of kills.
    #[arg(long, default_value_t = 200)]
    kills: u32,
    /// Interval between two kills, in milliseconds.
    #[arg(long, default_value_t = 250)]
    spacing_ms: u64,
    /// Pause of an address between two messages, in milliseconds.
    #[arg(long, default_value_t = 6)]
    pause_ms: u64,
    #[command(flatten)]
    seed: Seed,
}

pub(super) fn execute(arguments: Arguments) -> ExitCode {
    let Arguments { kills, spacing_ms, pause_ms, seed: Seed { seed } } = arguments;
    let report = run(Plan {
        processes: 8,
        kills,
        spacing: Duration::from_millis(spacing_ms),
        pause: Duration::from_millis(pause_ms),
        seed,
    });
    println!("{report}");
    if report.holds() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
