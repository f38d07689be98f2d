//! The robot of `examples/exoskeleton` under faults.

use std::process::ExitCode;

fn main() -> ExitCode {
    sinew_robot_tests::main()
}
