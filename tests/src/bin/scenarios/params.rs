//! Sets parameters of four nodes as one transaction, many times, while one of them is killed or cut off.
//!
//! `cargo run --release -p sinew-tests -- params [OPTIONS]`.
//!
//! Exit code 1: living nodes had the values of one transaction in part, a node that was restarted or cut off did not
//! get them afterwards, or an answer was not true.

use std::process::ExitCode;

use clap::Args;
use sinew_testkit::options::Seed;
use sinew_tests::params::{Plan, run};

/// Sets parameters of four nodes as one transaction, many times, while one of them is killed or cut off.
///
/// Each node has a host of its own, made of network namespaces: needs root and `ip`. The fault comes at a random time
/// of the transaction, half of them while the nodes accept. The coordinator's node may be the one.
#[derive(Args)]
pub(super) struct Arguments {
    /// Number of transactions.
    #[arg(long, default_value_t = 100)]
    rounds: u32,
    /// One transaction of so many has a cut instead of a kill; 0: none.
    #[arg(long, default_value_t = 10)]
    cut_every: u32,
    #[command(flatten)]
    seed: Seed,
}

pub(super) fn execute(arguments: Arguments) -> ExitCode {
    let Arguments { rounds, cut_every, seed: Seed { seed } } = arguments;
    match run(&Plan { rounds, cut_every, seed }) {
        Ok(report) => {
            println!("{report}\n{}", report.json());
            if report.holds() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
        }
        Err(why) => {
            println!("no hosts can be made here: {why}");
            ExitCode::FAILURE
        }
    }
}
