//! Runs every attack of the threat model against a secured robot, on hosts made of network namespaces, and
//! prints the results.
//!
//! `cargo run --release -p sinew-tests -- attacks [OPTIONS]`.;
//! `--help` lists the options. Requires root.
//!
//! Exit codes:
//!
//! - 1: an attack was not held off.
//! - 2: no hosts can be created here.
//! - 3: all attacks were held off, but live traffic was slowed down, or the machine was not idle, so that the
//!   slowdown is unknown.

use std::{process::ExitCode, time::Duration};

use clap::Args;
use sinew_tests::attacks::{Plan, known, run};

/// Runs every attack of the threat model against a secured robot.
#[derive(Args)]
pub(super) struct Arguments {
    /// Runs only this attack; may be repeated.
    #[arg(long)]
    only: Vec<String>,
    /// Measuring time of live traffic in each of the three states (no attack, decoy attacked, node attacked),
    /// summed over all rounds. The check for intrusions takes half as long.
    #[arg(long, default_value_t = 8.0)]
    seconds: f64,
    /// Number of rounds over these three states.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..))]
    rounds: u32,
    /// Prints JSON instead of a table.
    #[arg(long)]
    json: bool,
    /// Lists all attacks.
    #[arg(long)]
    list: bool,
}

pub(super) fn execute(arguments: Arguments) -> ExitCode {
    let Arguments { only, seconds, rounds, json, list } = arguments;
    if list {
        known().iter().for_each(|(name, tried)| println!("{name:<20} {tried}"));
        return ExitCode::SUCCESS;
    }
    let timed = Duration::from_secs_f64(seconds);
    let report = match run(&Plan { lasts: timed / 2, timed, rounds, only }) {
        Ok(report) => report,
        Err(why) => {
            println!("skipped: {why}");
            return ExitCode::from(2);
        }
    };
    if json {
        println!("{:#}", report.json())
    } else {
        println!("{report}")
    }
    match (report.has_held(), report.is_unfelt()) {
        (false, _) => ExitCode::FAILURE,
        (true, false) => ExitCode::from(3),
        (true, true) => ExitCode::SUCCESS,
    }
}
