//! The command line of the exoskeleton example.

#![warn(clippy::print_stdout, clippy::print_stderr)] // `output` prints: the macros panic if a pipe is closed or a disk is full.

mod cli;

use std::process::ExitCode;

use exoskeleton::output;

fn main() -> ExitCode {
    output::main("exoskeleton", cli::run)
}
