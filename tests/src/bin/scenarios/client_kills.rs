//! Kills processes at random instants, under load, while they hold loans. Reports the resources held by the
//! others afterwards, their message latency, and the files left behind.
//!
//! `cargo run --release -p sinew-tests -- client_kills [OPTIONS]`.
//!
//! Exit codes:
//!
//! - 1: a resource was not released, a file was left behind, or a message of another process was lost.
//! - 3: none of that, but the others were slowed down: their p99 with kills exceeds 1.1 times that with
//!   orderly ends, or that without ends, by more than noise explains.
//! - 4: unknown, because of noise or too little traffic.
//!
//! The limit is for one end per second (`--spacing-ms 1000 --reference-each 5`, 25 minutes). With faster ends
//! the ratio is printed but not judged, because starting new processes keeps two CPUs busy.

use std::{process::ExitCode, time::Duration};

use clap::Args;
use sinew_testkit::options::Seed;
use sinew_tests::clients::kills::{Plan, Verdict, run};

/// Kills processes at random instants, under load, while they hold loans.
///
/// The environment variable SINEW_TEST_TRANSPORT selects the transport: `socket`, `ring` (all through the node),
/// `direct` or `automatic` (default).
#[derive(Args)]
pub(super) struct Arguments {
    /// Number of kills.
    #[arg(long, default_value_t = 1_000)]
    kills: u32,
    /// One process ends in each interval of this length, in milliseconds.
    #[arg(long, default_value_t = 40)]
    spacing_ms: u64,
    /// One of this many groups of twenty kills is accompanied by an equally long period with orderly ends,
    /// and one without ends.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    reference_each: u32,
    /// Runs the victims at the lowest priority (nice 19).
    #[arg(long)]
    yields: bool,
    #[command(flatten)]
    seed: Seed,
}

pub(super) fn execute(arguments: Arguments) -> ExitCode {
    let Arguments { kills, spacing_ms, reference_each, yields, seed: Seed { seed } } = arguments;
    println!("seed {seed}");
    let report =
        run(Plan { kills, spacing: Duration::from_millis(spacing_ms), reference_each, seed, yields });
    println!("{report}");
    if !report.holds() {
        return ExitCode::FAILURE;
    }
    match report.felt().verdict() {
        Verdict::Broken => {
            println!("LIMIT BROKEN: others felt it");
            ExitCode::from(3)
        }
        Verdict::Noise | Verdict::TooFew => {
            println!("nobody knows whether others felt it: repeat it, at rest");
            ExitCode::from(4)
        }
        Verdict::Kept | Verdict::Crowded => ExitCode::SUCCESS,
    }
}
