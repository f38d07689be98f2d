//! The robot of `examples/exoskeleton` under faults: the program `robot_faults`, and the handling of processes
//! in tests of the robot.

#![warn(clippy::print_stdout, clippy::print_stderr)] // `exoskeleton::output` prints, and keeps the error of a full disk.

use std::process::ExitCode;

use exoskeleton::output;

mod campaign;
mod claim;
mod cli;
mod contrast;
mod evidence;
mod hosts;
mod judge;
mod operator;
mod picture;
pub mod process;
mod robot;
mod script;
mod step;

/// Runs the program `robot_faults`; returns its exit code.
#[must_use]
pub fn main() -> ExitCode {
    output::main("robot_faults", cli::run)
}
