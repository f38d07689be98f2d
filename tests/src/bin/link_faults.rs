//! Lets a thousand things happen to the link between two nodes under load, and says what became of every message.
//!
//! `cargo run --release -p sinew-tests --bin link_faults -- [OPTIONS]`; `--help` names them.
//!
//! Exit code 1: a message was lost, double or out of order, or an outcome was missing, double or false.

use std::{process::ExitCode, time::Duration};

use clap::Parser;
use sinew_tests::link_faults::{Plan, Trouble, play, run};

/// Lets things happen to the link between two nodes, each in turn, and counts the messages.
///
/// The nodes are processes of their own, with a faulty network between them. Clocks that jump are their wall clocks, and theirs alone; they
/// need a C compiler, `cc`. (Nobody can set the monotonic clock, which is all that a running node reads; its start reads the wall clock once,
/// for its incarnation.)
#[derive(Parser)]
struct Arguments {
    /// How often something happens, over all.
    #[arg(long, default_value_t = 1_000)]
    faults: u64,
    /// What happens: cut, finish, panic-sender, panic-receiver, stall, part-there, part-back, freeze, kill-receiver, kill-sender,
    /// clock-on, clock-back.
    #[arg(long, value_delimiter = ',', default_value = "cut,panic-sender,finish,panic-receiver")]
    what: Vec<Trouble>,
    /// Messages from the first node to the second, a second.
    #[arg(long, default_value_t = 10_000)]
    rate: u64,
    /// Messages the other way, a second.
    #[arg(long, default_value_t = 1_000)]
    back_rate: u64,
    /// Bytes of each message, besides its numbers. 0 to 65,536.
    #[arg(long, default_value_t = 128, value_parser = clap::value_parser!(u32).range(0..=65_536))]
    filling: u32,
    /// From one fault to the next, in milliseconds; by chance up to half of it more.
    #[arg(long, default_value_t = 30)]
    spacing_ms: u64,
    /// How long what lasts does last (stall, part, freeze), in milliseconds.
    #[arg(long, default_value_t = 10_000)]
    hold_ms: u64,
    /// One bit of about so many bytes that pass is flipped, all the time. 0: none.
    #[arg(long, default_value_t = 0)]
    one_flip_in: u32,
    /// What all chance comes from; another one each time if it is not given.
    #[arg(long, default_value_t = u64::from(std::process::id()))]
    seed: u64,
}

fn main() -> ExitCode {
    if let Some(code) = play() {
        return code;
    }
    let arguments = Arguments::parse();
    let report = run(&Plan {
        program: std::env::current_exe().expect("a program has a path"),
        rate: arguments.rate,
        back_rate: arguments.back_rate,
        filling: arguments.filling as usize,
        troubles: arguments.what,
        faults: arguments.faults,
        spacing: Duration::from_millis(arguments.spacing_ms),
        hold: Duration::from_millis(arguments.hold_ms),
        one_flip_in: Some(arguments.one_flip_in).filter(|bytes| *bytes > 0),
        seed: arguments.seed,
    });
    println!("{report}\n{}", report.json());
    if report.holds() { ExitCode::SUCCESS } else { ExitCode::FAILURE }
}
