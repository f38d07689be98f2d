//! Loses, pauses, delays and stops the sender of two outputs on other nodes many times, and reports the time until each
//! output was safe against the time of its contract.
//!
//! `cargo run --release -p sinew-tests -- contracts [OPTIONS]`.
//!
//! Exit code 1: an output was safe later than its contract says, or the contracts do not close.

use std::process::ExitCode;

use clap::Args;
use sinew_tests::contracts::{Plan, run};

/// Loses, pauses, delays and stops the sender of two outputs on other nodes many times.
///
/// Three nodes on loopback, each in a process of its own: `central` commands an output on `left` and on `right`. In
/// turn its process is killed, paused, cut off from the echoes of the outputs, stopped in order, and the stop of the
/// whole system is pressed.
#[derive(Args)]
pub(super) struct Arguments {
    /// Number of injected conditions.
    #[arg(long, default_value_t = 200)]
    rounds: u32,
}

pub(super) fn execute(arguments: Arguments) -> ExitCode {
    let report = run(Plan { rounds: arguments.rounds });
    println!("{report}\n{}", report.json());
    if report.holds() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
