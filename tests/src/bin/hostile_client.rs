//! Lets hostile clients do to a node what they like, and says what it held, how others were served, and what it refused.
//!
//! `cargo run --release -p sinew-tests --bin hostile_client [OPTIONS]`; `--help` names them.
//!
//! Exit code 1: the node went beyond its bound, gave something not back, did not serve the others, or refused in silence.

use std::{process::ExitCode, time::Duration};

use clap::Parser;
use sinew_tests::clients::{
    Kernel,
    hostile::{Plan, run},
    play,
};

/// Lets hostile clients do to a node what they like, for the minutes and seconds together, 5 seconds at least.
///
/// The environment variable SINEW_TEST_TRANSPORT chooses the others' way: `socket`, `ring` (default) or `direct`.
#[derive(Parser)]
struct Arguments {
    /// How many minutes.
    #[arg(long, default_value_t = 0)]
    minutes: u64,
    /// And how many seconds.
    #[arg(long, default_value_t = 0)]
    seconds: u64,
    /// What all chance comes from; another one each time if it is not given.
    #[arg(long, default_value_t = u64::from(std::process::id()))]
    seed: u64,
    /// As on Linux before 6.16: the system cannot be told to let no descriptors come.
    #[arg(long)]
    old_kernel: bool,
}

fn main() -> ExitCode {
    if let Some(code) = play() {
        return code;
    }
    let Arguments { minutes, seconds, seed, old_kernel } = Arguments::parse();
    println!("seed {seed}");
    let report = run(Plan {
        program: std::env::current_exe().expect("a program has a path"),
        lasts: Duration::from_secs((minutes * 60 + seconds).max(5)),
        seed,
        kernel: if old_kernel { Kernel::WithoutPassRights } else { Kernel::Present },
        held_up_max: Duration::from_secs(1),
    });
    println!("{report}");
    if report.holds() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
