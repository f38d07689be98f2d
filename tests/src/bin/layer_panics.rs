//! Lets a thousand layers panic under load, each layer in turn, and says what became of the messages.
//!
//! `cargo run --release -p sinew-tests --bin layer_panics [--panics N] [--strict]`
//!
//! Exit code 1: a message within the node was lost, double or out of order, an outcome was wrong, or an application was
//! restarted; with `--strict` also: a message between the nodes was lost. 3: a layer took longer than its limit.

use std::{process::ExitCode, time::Duration};

use sinew_tests::load::{Plan, run};

/// From a panic until the layer is ready again, 99 of 100.
const READY_WITHIN: Duration = Duration::from_millis(10);

fn main() -> ExitCode {
    // A thousand panics would fill the terminal; their words are in each supervisor's log.
    std::panic::set_hook(Box::new(|_| {}));
    let arguments: Vec<String> = std::env::args().skip(1).collect();
    let number = |flag: &str, otherwise: u64| {
        let after = arguments.iter().skip_while(|argument| *argument != flag).nth(1);
        after.map_or(otherwise, |value| value.parse().unwrap_or_else(|_| panic!("{flag} takes a number")))
    };
    let plan = Plan {
        panics: number("--panics", 1_000),
        in_process: number("--in-process", 100_000),
        between_nodes: number("--between-nodes", 10_000),
        spacing: Duration::from_millis(number("--spacing-ms", 30)),
    };
    let report = run(plan);
    println!("{report}\n{}", report.json());
    let is_strict = arguments.iter().any(|argument| argument == "--strict");
    let between = report.between_nodes;
    if !report.in_process.is_perfect()
        || !between.is_true()
        || report.restarted > 0
        || is_strict && !between.is_perfect()
    {
        println!("LIMIT BROKEN: messages");
        return ExitCode::FAILURE;
    }
    if let Some(late) = report.layers.iter().find(|layer| layer.ready.percentile(0.99) > READY_WITHIN) {
        println!("LIMIT BROKEN: {} took longer than {READY_WITHIN:?}", late.name);
        return ExitCode::from(3);
    }
    ExitCode::SUCCESS
}
