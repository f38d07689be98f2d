//! Round trips on each path of a message within one node, beside a raw reference of the same run.
//!
//! `cargo bench -p sinew --bench paths [-- WORD...]` prints one JSON line per case, for the cases that have
//! every WORD in their names. Every case runs in fresh processes, three times: placed by the scheduler, with
//! everything on one CPU, and with one CPU for each end. Times are microseconds per round trip. Nothing here
//! asserts a time.

mod case;
#[path = "../ping/mod.rs"]
mod ping;
mod raw;
mod sinew_ends;

use std::process::ExitCode;

use case::{CASES, Case};
use sinew_figures::{Asked, Pace, Pinning, Rounds, process};

/// The environment variable that sets another number of rounds: a profile needs more.
const ROUNDS_WANTED: &str = "SINEW_PATHS_ROUNDS";

fn main() -> ExitCode {
    if let Some(role) = process::role() {
        return play(&role);
    }
    let wanted = Asked::read(include_str!("main.rs"), &[]).wanted(CASES, |case| case.name.to_owned());
    eprintln!("machine: {}", sinew_figures::machine());
    let mut failed = false;
    for case in wanted {
        for pinning in Pinning::ALL {
            failed |= !run(case, pinning);
        }
    }
    if failed { ExitCode::FAILURE } else { ExitCode::SUCCESS }
}

/// Returns the round trips of this payload size.
fn rounds(bytes: usize) -> Rounds {
    let rounds = Rounds::of(bytes, Pace::BackToBack, false);
    let wanted = std::env::var(ROUNDS_WANTED).ok().and_then(|wanted| wanted.parse().ok());
    Rounds { counted: wanted.unwrap_or(rounds.counted), ..rounds }
}

/// Runs a case in a process of its own.
fn run(case: &Case, pinning: Pinning) -> bool {
    let worked = process::has_run(process::command(&format!("measure {} {}", case.name, pinning.name())));
    if !worked {
        eprintln!("{} {}: failed", case.name, pinning.name());
    }
    worked
}

fn play(role: &str) -> ExitCode {
    let words: Vec<&str> = role.split(' ').collect();
    match words[..] {
        ["measure", case, pinning] => case::measure(case, pinning),
        ["echo", kind, pinning, at] => case::echo(kind, pinning, at),
        _ => {
            eprintln!("no such role: {role}");
            return ExitCode::FAILURE;
        }
    }
    ExitCode::SUCCESS
}
