//! Round trips on each path a message can take, beside a raw reference of the same run.
//!
//! `cargo bench -p sinew --bench paths [-- CASE...]` prints one JSON line a case. Every case runs in fresh processes,
//! three times: wherever the scheduler likes, with everything on one CPU, and with one CPU for each end. Times are
//! microseconds, there and back. Nothing here asserts a time.

mod case;
mod raw;
mod sinew_ends;

use std::process::{Command, ExitCode, Stdio};

use case::{CASES, Case};
use sinew_figures::Pinning;

/// The role of a process that this program starts of itself.
const ROLE: &str = "SINEW_PATHS_ROLE";
/// Round trips that are not counted.
const WARM_UP: u64 = 1_000;
/// Round trips that are.
const ROUNDS: u64 = 20_000;
/// The environment variable that says another number: a profile needs more.
const ROUNDS_WANTED: &str = "SINEW_PATHS_ROUNDS";

fn main() -> ExitCode {
    if let Ok(role) = std::env::var(ROLE) {
        return play(&role);
    }
    let wanted: Vec<String> = std::env::args().skip(1).filter(|arg| !arg.starts_with('-')).collect();
    eprintln!("machine: {}", sinew_figures::machine());
    let mut failed = false;
    for case in CASES.iter().filter(|case| wanted.is_empty() || wanted.iter().any(|w| case.name.contains(w)))
    {
        for pinning in Pinning::ALL {
            failed |= !run(case, pinning);
        }
    }
    if failed { ExitCode::FAILURE } else { ExitCode::SUCCESS }
}

/// Round trips that are counted.
fn rounds() -> u64 {
    let wanted = std::env::var(ROUNDS_WANTED).ok();
    wanted.and_then(|wanted| wanted.parse().ok()).unwrap_or(ROUNDS)
}

/// Runs a case in a process of its own.
fn run(case: &Case, pinning: Pinning) -> bool {
    let program = std::env::current_exe().expect("this program has a path");
    let role = format!("measure {} {}", case.name, pinning.name());
    let status = Command::new(program).env(ROLE, role).stdin(Stdio::null()).status();
    let worked = status.is_ok_and(|status| status.success());
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
