//! Makes an application too slow for the messages of another node, and reports the cost.
//!
//! `cargo run --release -p sinew-tests -- slow_consumer [OPTIONS]`.
//!
//! Exit codes:
//!
//! - 1: a node exceeded its memory bound, or a request of another application had no answer.
//! - 3: the p99 of the others was more than 1.5 times as long.

use std::{process::ExitCode, time::Duration};

use clap::Args;
use sinew_tests::slow_consumer::{Plan, run};

/// Makes an application too slow for the messages of another node. Measures both nodes' memory and others'
/// round trips.
#[derive(Args)]
pub(super) struct Arguments {
    /// Duration of the slow phase, in minutes.
    #[arg(long, default_value_t = 10.0)]
    minutes: f64,
    /// Bulk messages per second offered to it.
    #[arg(long, default_value_t = 10_000)]
    rate: u64,
    /// Length of each message, 0 to 1,000,000 bytes.
    #[arg(long, default_value_t = 1_000, value_parser = clap::value_parser!(u32).range(0..=1_000_000))]
    length: u32,
    /// Processing time of each message, in milliseconds.
    #[arg(long, default_value_t = 10)]
    takes_ms: u64,
    /// Duration of each reference measurement (without Bulk, then with a fast consumer), in seconds.
    #[arg(long, default_value_t = 60)]
    reference_s: u64,
}

pub(super) fn execute(arguments: Arguments) -> ExitCode {
    let Arguments { minutes, rate, length, takes_ms, reference_s } = arguments;
    let report = run(&Plan {
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
