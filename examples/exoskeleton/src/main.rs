//! The command line of the exoskeleton example.

#![warn(clippy::print_stdout, clippy::print_stderr)] // `output` prints: the macros panic where a pipe is closed or a disk is full.

mod cli;

use std::process::ExitCode;

use clap::Parser;
use exoskeleton::output;

fn main() -> ExitCode {
    let code = match cli::Arguments::try_parse() {
        Ok(arguments) => run(&arguments),
        Err(error) => refused(&error),
    };
    let Some(error) = output::failure() else { return code };
    output::note(format_args!(
        "exoskeleton: standard output is incomplete: {error}; free space where it goes, or send it elsewhere"
    ));
    if code == ExitCode::SUCCESS { ExitCode::FAILURE } else { code }
}

fn run(arguments: &cli::Arguments) -> ExitCode {
    match cli::run(arguments) {
        Ok(verdict) => verdict.code(),
        Err(error) => {
            output::note(format_args!("exoskeleton: {error}"));
            ExitCode::FAILURE
        }
    }
}

/// A wrong command line, or one that asks for help or the version.
fn refused(error: &clap::Error) -> ExitCode {
    let printed = error.print();
    if error.use_stderr() {
        return ExitCode::from(2);
    }
    output::keep(printed);
    ExitCode::SUCCESS
}
