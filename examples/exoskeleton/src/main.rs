//! The command line of the exoskeleton example.

mod cli;

use std::process::ExitCode;

use clap::Parser;

/// 0: all limits held. 1: it did not walk. 2: the arguments are wrong. 3: it walked and a limit did not hold.
fn main() -> ExitCode {
    match cli::run(&cli::Arguments::parse()) {
        Ok(cli::Verdict::LimitsHeld) => ExitCode::SUCCESS,
        Ok(cli::Verdict::LimitBroken) => ExitCode::from(3),
        Ok(cli::Verdict::NodeEnded(code)) => code,
        Err(error) => {
            eprintln!("exoskeleton: {error}");
            ExitCode::from(1)
        }
    }
}
