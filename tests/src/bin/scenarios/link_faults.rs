//! Injects a thousand faults into the link between two nodes under load, and accounts for every message.
//!
//! `cargo run --release -p sinew-tests -- link_faults [OPTIONS]`.
//!
//! Exit code 1: a message was lost, duplicated or reordered, or an outcome was missing, duplicated or false.

use std::{process::ExitCode, time::Duration};

use clap::Args;
use sinew_testkit::options::Seed;
use sinew_tests::link_faults::{Plan, Trouble, run};

/// Injects faults into the link between two nodes, each kind in turn, and counts the messages.
///
/// The nodes are separate processes with a faulty network between them. The clock faults change only the wall
/// clocks of these processes, and need a C compiler, `cc`. (The monotonic clock cannot be set, and a running
/// node reads no other clock; only its start reads the wall clock once, for its incarnation.)
#[derive(Args)]
pub(super) struct Arguments {
    /// Total number of faults.
    #[arg(long, default_value_t = 1_000)]
    faults: u64,
    /// Kinds of faults: cut, finish, panic-sender, panic-receiver, stall, part-there, part-back, freeze,
    /// kill-receiver, kill-sender, clock-on, clock-back.
    #[arg(long, value_delimiter = ',', default_value = "cut,panic-sender,finish,panic-receiver")]
    what: Vec<Trouble>,
    /// Messages per second from the first node to the second.
    #[arg(long, default_value_t = 10_000)]
    rate: u64,
    /// Messages per second in the other direction.
    #[arg(long, default_value_t = 1_000)]
    back_rate: u64,
    /// Filler bytes of each message, 0 to 65,536.
    #[arg(long, default_value_t = 128, value_parser = clap::value_parser!(u32).range(0..=65_536))]
    filling: u32,
    /// Interval between two faults, in milliseconds, randomly extended by up to a half.
    #[arg(long, default_value_t = 30)]
    spacing_ms: u64,
    /// Duration of lasting faults (stall, part, freeze), in milliseconds.
    #[arg(long, default_value_t = 10_000)]
    hold_ms: u64,
    /// Flips about one bit in this many bytes, all the time. 0: none.
    #[arg(long, default_value_t = 0)]
    one_flip_in: u32,
    #[command(flatten)]
    seed: Seed,
}

pub(super) fn execute(arguments: Arguments) -> ExitCode {
    let report = run(&Plan {
        rate: arguments.rate,
        back_rate: arguments.back_rate,
        filling: arguments.filling as usize,
        troubles: arguments.what,
        faults: arguments.faults,
        spacing: Duration::from_millis(arguments.spacing_ms),
        hold: Duration::from_millis(arguments.hold_ms),
        one_flip_in: Some(arguments.one_flip_in).filter(|bytes| *bytes > 0),
        seed: arguments.seed.seed,
    });
    println!("{report}\n{}", report.json());
    if report.holds() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
