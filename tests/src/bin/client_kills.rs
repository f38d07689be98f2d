//! Kills processes at random instants, under load, while they hold loans, and says what the others hold after it, how long
//! their messages took, and what is left in the file system.
//!
//! `cargo run --release -p sinew-tests --bin client_kills [OPTIONS]`; `--help` names them.
//!
//! Exit code 1: something was not given back, a file was left, or a message of others was lost. 3: none of that, and others felt it:
//! their p99 with kills was more than 1.1 times as long as with orderly ends, or while nobody ends, and more than noise makes of that.
//! 4: nobody knows, as noise hides it or there was too little traffic.
//! That limit is for one end a second (`--spacing-ms 1000 --reference-each 5`, 25 minutes), and is told and not judged where they come
//! faster: that keeps two CPUs busy with newcomers.

use std::{process::ExitCode, time::Duration};

use clap::Parser;
use sinew_tests::clients::{
    kills::{Plan, Verdict, run},
    play,
};

/// Kills processes at random instants, under load, while they hold loans.
///
/// The environment variable SINEW_TEST_TRANSPORT chooses their way: `socket`, `ring` (default) or `direct`.
#[derive(Parser)]
struct Arguments {
    /// How many processes are killed.
    #[arg(long, default_value_t = 1_000)]
    kills: u32,
    /// One process ends in each such time, in milliseconds.
    #[arg(long, default_value_t = 40)]
    spacing_ms: u64,
    /// Of so many times twenty kills one has as long with orderly ends beside it, and as long with none.
    #[arg(long, default_value_t = 1, value_parser = clap::value_parser!(u32).range(1..))]
    reference_each: u32,
    /// Those that are killed have the lowest priority (nice 19).
    #[arg(long)]
    yields: bool,
    /// What all chance comes from; another one each time if it is not given.
    #[arg(long, default_value_t = u64::from(std::process::id()))]
    seed: u64,
}

fn main() -> ExitCode {
    if let Some(code) = play() {
        return code;
    }
    let Arguments { kills, spacing_ms, reference_each, yields, seed } = Arguments::parse();
    println!("seed {seed}");
    let report = run(Plan {
        program: std::env::current_exe().expect("a program has a path"),
        kills,
        spacing: Duration::from_millis(spacing_ms),
        reference_each,
        seed,
        yields,
    });
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
