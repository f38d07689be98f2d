//! The command line of the exoskeleton example.

mod cli;

use std::process::ExitCode;

use clap::Parser;

fn main() -> ExitCode {
    match cli::run(&cli::Arguments::parse()) {
        Ok(cli::Verdict::LimitsHeld) => ExitCode::SUCCESS,
        Ok(cli::Verdict::LimitBroken) => ExitCode::from(1),
        Err(error) => {
            eprintln!("exoskeleton: {error}");
            ExitCode::from(2)
        }
    }
}
