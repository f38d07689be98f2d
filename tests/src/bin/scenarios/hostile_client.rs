//! Runs hostile clients against a node, and reports its resources, its service to others, and its refusals.
//!
//! `cargo run --release -p sinew-tests -- hostile_client [OPTIONS]`.
//!
//! Exit code 1: the node exceeded its bound, did not release a resource, did not serve the others, or did not
//! count a refusal.

use std::{process::ExitCode, time::Duration};

use clap::Args;
use sinew_testkit::options::Seed;
use sinew_tests::clients::{
    Kernel,
    hostile::{Plan, run},
};

/// Runs hostile clients against a node for the sum of the minutes and seconds, at least 5 seconds.
///
/// The environment variable SINEW_TEST_TRANSPORT selects the transport of the others: `socket`, `ring` (all
/// through the node), `direct` or `automatic` (default).
#[derive(Args)]
pub(super) struct Arguments {
    /// Duration in minutes.
    #[arg(long, default_value_t = 0)]
    minutes: u64,
    /// Additional seconds.
    #[arg(long, default_value_t = 0)]
    seconds: u64,
    #[command(flatten)]
    seed: Seed,
    /// Emulates Linux before 6.16, which cannot refuse descriptors that arrive over a socket.
    #[arg(long)]
    old_kernel: bool,
}

pub(super) fn execute(arguments: Arguments) -> ExitCode {
    let Arguments { minutes, seconds, seed: Seed { seed }, old_kernel } = arguments;
    println!("seed {seed}");
    let report = run(Plan {
        lasts: Duration::from_secs((minutes * 60 + seconds).max(5)),
        seed,
        kernel: if old_kernel { Kernel::WithoutPassRights } else { Kernel::Present },
        held_up_max: Duration::from_secs(1),
    });
    println!("{report}");
    if report.holds() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
