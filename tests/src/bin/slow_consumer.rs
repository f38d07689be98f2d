//! Lets an application be too slow for what another node sends to it, and says what that costs.
//!
//! `cargo run --release -p sinew-tests --bin slow_consumer -- --minutes 10`; `--help` names the options.
//!
//! Exit code 1: a node held more than its bound, or a question of others had no answer. 3: their p99 was more than 1.5 times as long.

use std::{process::ExitCode, time::Duration};

use clap::Parser;
use sinew_tests::slow_consumer::{Plan, play, run};

/// Lets an application be too slow for what another node sends to it; measures both nodes' memory and others' round trips.
#[derive(Parser)]
struct Arguments {
    /// How long it is slow, in minutes.
    #[arg(long, default_value_t = 10.0)]
    minutes: f64,
    /// Bulk messages a second that are offered to it.
    #[arg(long, default_value_t = 10_000)]
    rate: u64,
    /// Bytes of each. 0 to 1,000,000.
    #[arg(long, default_value_t = 1_000, value_parser = clap::value_parser!(u32).range(0..=1_000_000))]
    length: u32,
    /// What it takes for each, in milliseconds.
    #[arg(long, default_value_t = 10)]
    takes_ms: u64,
    /// How long it is looked on without Bulk, and then with a consumer that keeps up, in seconds.
    #[arg(long, default_value_t = 60)]
    reference_s: u64,
}

fn main() -> ExitCode {
    if let Some(code) = play() {
        return code;
    }
    let Arguments { minutes, rate, length, takes_ms, reference_s } = Arguments::parse();
    let report = run(&Plan {
        program: std::env::current_exe().expect("a program has a path"),
        lasts: Duration::from_secs_f64(minutes * 60.0),
        rate,
        length: length as usize,
        takes: Duration::from_millis(takes_ms),
        reference: Duration::from_secs(reference_s),
    });
    println!("{report}\n{}", report.json());
    if !report.is_bounded() {
        println!("LIMIT BROKEN: memory, or a question without an answer");
        return ExitCode::FAILURE;
    }
    if !report.is_unfelt() {
        println!("LIMIT BROKEN: others felt it");
        return ExitCode::from(3);
    }
    ExitCode::SUCCESS
}
