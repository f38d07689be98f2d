//! Records a node under load, and measures the calls that send with and without the recording, in turns.
//!
//! `cargo build --release -p sinew-cli && cargo run --release -p sinew-tests -- recording [OPTIONS]`.
//!
//! Exit code 1: a message is neither in a file nor counted as dropped, or `sinew record` reported a fault.

use std::{process::ExitCode, time::Duration};

use clap::Args;
use sinew_tests::recording::{Load, Plan, run};

/// Records a node under load, and measures the calls that send with and without the recording, in turns.
///
/// It runs the command `sinew` beside its own program: build it in the same profile before.
#[derive(Args)]
pub(super) struct Arguments {
    /// Number of sources, each with a channel.
    #[arg(long, default_value_t = 10, value_parser = clap::value_parser!(u64).range(1..=100))]
    channels: u64,
    /// Messages per second of each. A slow machine sends fewer.
    #[arg(long, default_value_t = 10_000, value_parser = clap::value_parser!(u64).range(1..))]
    rate: u64,
    /// Filler bytes of each message, 0 to 1,000,000.
    #[arg(long, default_value_t = 64, value_parser = clap::value_parser!(u64).range(0..=1_000_000))]
    length: u64,
    /// Duration of each round, in seconds.
    #[arg(long, default_value_t = 4, value_parser = clap::value_parser!(u64).range(1..=20))]
    seconds: u64,
    /// Rounds without and with a recording.
    #[arg(long, default_value_t = 5)]
    rounds: u32,
    /// Time that each write to the file takes longer, in milliseconds. Needs a C compiler, `cc`.
    #[arg(long, default_value_t = 0)]
    write_takes_ms: u64,
    /// Bytes of the node's ring, instead of the default.
    #[arg(long)]
    keep_bytes: Option<u64>,
}

pub(super) fn execute(arguments: Arguments) -> ExitCode {
    let Arguments { channels, rate, length, seconds, rounds, write_takes_ms, keep_bytes } = arguments;
    let report = run(&Plan {
        sources: channels,
        load: Load { rate, length, count: rate * seconds },
        rounds,
        write_takes: Duration::from_millis(write_takes_ms),
        keep_bytes,
    });
    println!("{report}\n{}", report.json());
    if report.holds() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
