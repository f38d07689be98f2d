//! Attacks a secured robot in every way of the threat model, on hosts of network namespaces, and says what came of it.
//!
//! `cargo run --release -p sinew-tests --bin attacks [-- --only NAME --seconds N --json]`; `--help` names the options. As root.
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
    /// How long each attack lasts, and the time before that it is compared with.
    #[arg(long, default_value_t = 10.0)]
    seconds: f64,
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
    let Arguments { only, seconds, json, list } = Arguments::parse();
    if list {
        known().iter().for_each(|(name, tried)| println!("{name:<20} {tried}"));
        return ExitCode::SUCCESS;
    }
    let program = std::env::current_exe().expect("a program has a path");
    let report = match run(&Plan { program, lasts: Duration::from_secs_f64(seconds), only }) {
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
