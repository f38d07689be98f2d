//! Makes a thousand layers panic under load, each layer in turn, and accounts for the messages.
//!
//! `cargo run --release -p sinew-tests -- layer_panics [OPTIONS]`.
//!
//! Exit codes:
//!
//! - 1: a message within a node or between two nodes was lost, duplicated or reordered, an outcome was wrong,
//!   or an application was restarted.
//! - 3: a layer took longer than its limit.

use std::{process::ExitCode, time::Duration};

use clap::Args;
use sinew_tests::load::{Plan, run};

/// Limit of the 99th percentile of the time from a panic until the layer is ready again.
const READY_WITHIN: Duration = Duration::from_millis(10);

/// Makes layers panic under load, each layer in turn, and counts the messages.
#[derive(Args)]
pub(super) struct Arguments {
    /// Total number of panics.
    #[arg(long, default_value_t = 1_000)]
    panics: u64,
    /// Messages per second within a node.
    #[arg(long, default_value_t = 100_000)]
    in_process: u64,
    /// Messages per second between two nodes.
    #[arg(long, default_value_t = 10_000)]
    between_nodes: u64,
    /// Interval between two panics, in milliseconds.
    #[arg(long, default_value_t = 30)]
    spacing_ms: u64,
}

pub(super) fn execute(arguments: Arguments) -> ExitCode {
    // Suppresses the messages of a thousand panics; they are in each supervisor's log.
    std::panic::set_hook(Box::new(|_| {}));
    let Arguments { panics, in_process, between_nodes, spacing_ms } = arguments;
    let plan = Plan { panics, in_process, between_nodes, spacing: Duration::from_millis(spacing_ms) };
    let report = run(plan);
    println!("{report}\n{}", report.json());
    if !report.in_process.is_perfect() || !report.between_nodes.is_perfect() || report.restarted > 0 {
        println!("LIMIT BROKEN: messages");
        return ExitCode::FAILURE;
    }
    if let Some(late) = report.layers.iter().find(|layer| layer.ready.percentile(0.99) > READY_WITHIN) {
        println!("LIMIT BROKEN: {} took longer than {READY_WITHIN:?}", late.name);
        return ExitCode::from(3);
    }
    ExitCode::SUCCESS
}
