//! Attacks a secured robot in every way of the threat model, on hosts of network namespaces, and says what came of it.
//!
//! `cargo run --release -p sinew-tests --bin attacks [-- --only NAME --seconds N --rounds N --json]`; `--help` names the options. As root.
//!
//! Exit code 1: an attack was not held off. 3: all were, and live traffic felt one, or the machine was not at rest, so that nobody knows. 2: no hosts can be made here.

use std::{process::ExitCode, time::Duration};

use clap::Parser;
use sinew_tests::attacks::{Plan, known, play, run};

/// Attacks a secured robot in every way of the threat model.
#[derive(Parser)]
struct Arguments {
    /// Only these; several times for several.
    #[arg(long)]
    only: Vec<String>,
    /// How long live traffic is timed left alone, with the decoy attacked, and with the node attacked, each in all rounds together. It is
    /// looked for half as long who gets in.
    #[arg(long, default_value_t = 8.0)]
    seconds: f64,
    /// How often these three take turns.
    #[arg(long, default_value_t = 5, value_parser = clap::value_parser!(u32).range(1..))]
    rounds: u32,
    /// Writes JSON instead of a table.
    #[arg(long)]
    json: bool,
    /// Names all attacks.
    #[arg(long)]
    list: bool,
}

fn main() -> ExitCode {
    if let Some(code) = play() {
        return code;
    }
    let Arguments { only, seconds, rounds, json, list } = Arguments::parse();
    if list {
        known().iter().for_each(|(name, tried)| println!("{name:<20} {tried}"));
        return ExitCode::SUCCESS;
    }
    let program = std::env::current_exe().expect("a program has a path");
    let timed = Duration::from_secs_f64(seconds);
    let report = match run(&Plan { program, lasts: timed / 2, timed, rounds, only }) {
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
