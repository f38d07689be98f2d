//! Lets a thousand layers panic under load, each layer in turn, and says what became of the messages.
//!
//! `cargo run --release -p sinew-tests --bin layer_panics [OPTIONS]`; `--help` names them.
//!
//! Exit code 1: a message, within a node or between two, was lost, double or out of order, an outcome was wrong, or an
//! application was restarted. 3: a layer took longer than its limit.

use std::{process::ExitCode, time::Duration};

use clap::Parser;
use sinew_tests::load::{Plan, run};

/// From a panic until the layer is ready again, 99 of 100.
const READY_WITHIN: Duration = Duration::from_millis(10);

/// Lets layers panic under load, each layer in turn, and counts the messages.
#[derive(Parser)]
struct Arguments {
    /// How many layers panic, over all.
    #[arg(long, default_value_t = 1_000)]
    panics: u64,
    /// Messages per second within a node.
    #[arg(long, default_value_t = 100_000)]
    in_process: u64,
    /// Messages per second between two nodes.
    #[arg(long, default_value_t = 10_000)]
    between_nodes: u64,
    /// From one panic to the next, in milliseconds.
    #[arg(long, default_value_t = 30)]
    spacing_ms: u64,
}

fn main() -> ExitCode {
    // A thousand panics would fill the terminal; their words are in each supervisor's log.
    std::panic::set_hook(Box::new(|_| {}));
    let Arguments { panics, in_process, between_nodes, spacing_ms } = Arguments::parse();
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
