//! Presses the stop of the whole system many times on four nodes under load, of which one is cut off or killed at
//! times, and reports the time until each output was safe.
//!
//! `cargo run --release -p sinew-tests -- stops [OPTIONS]`.
//!
//! Exit code 1: a node that could be reached has not confirmed, a node that was cut off was not named or not safe
//! within the stated time, or an output moved during the stop or by the release.

use std::process::ExitCode;

use clap::Args;
use sinew_testkit::options::Seed;
use sinew_tests::stops::{Plan, run};

/// Presses the stop of the whole system many times on four nodes under load.
///
/// Each node has a host of its own, made of network namespaces: needs root and `ip`. The first node commands a guarded
/// output on each of the four.
#[derive(Args)]
pub(super) struct Arguments {
    /// Number of presses.
    #[arg(long, default_value_t = 200)]
    presses: u32,
    /// One press of so many is made while a node is cut off; 0: none.
    #[arg(long, default_value_t = 10)]
    cut_every: u32,
    /// One press of so many is made while a node is killed; 0: none.
    #[arg(long, default_value_t = 25)]
    kill_every: u32,
    /// Messages of 256 bytes that each node sends to the next one in a millisecond.
    #[arg(long, default_value_t = 5)]
    load: u32,
    #[command(flatten)]
    seed: Seed,
}

pub(super) fn execute(arguments: Arguments) -> ExitCode {
    let Arguments { presses, cut_every, kill_every, load, seed: Seed { seed } } = arguments;
    match run(&Plan { presses, cut_every, kill_every, load, seed }) {
        Ok(report) => {
            println!("{report}\n{}", report.json());
            if report.holds() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
        }
        Err(why) => {
            println!("no hosts can be made here: {why}");
            ExitCode::FAILURE
        }
    }
}
