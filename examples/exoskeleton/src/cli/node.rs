//! One part of the robot from the command line.

use std::path::PathBuf;

use exoskeleton::robot::node::{self, NodeOptions};
use exoskeleton::robot::role::Role;

use super::{RunError, Verdict};

#[derive(Debug, clap::Args)]
pub(super) struct NodeArguments {
    /// central, hip, knee, ankle or plant.
    role: Role,
    /// Which node of the robot is where; see `examples/exoskeleton/topology.toml`.
    #[arg(long, value_name = "FILE")]
    topology: PathBuf,
    /// Folder for its traces; without it there are none.
    #[arg(long, value_name = "DIR")]
    run_dir: Option<PathBuf>,
    /// Stop when the standard input ends: for whoever starts this from a program.
    #[arg(long)]
    stop_with_stdin: bool,
}

pub(super) fn run(arguments: &NodeArguments) -> Result<Verdict, RunError> {
    log_to_stderr();
    let options = NodeOptions {
        role: arguments.role,
        topology: arguments.topology.clone(),
        run_dir: arguments.run_dir.clone(),
        stop_with_stdin: arguments.stop_with_stdin,
    };
    Ok(Verdict::NodeEnded(node::run(&options)?))
}

/// What is logged says `RUST_LOG`; without it everything from `info` on.
fn log_to_stderr() {
    let filter = tracing_subscriber::EnvFilter::try_from_default_env()
        .unwrap_or_else(|_| tracing_subscriber::EnvFilter::new("info"));
    let log = tracing_subscriber::fmt().with_env_filter(filter).with_writer(std::io::stderr).with_ansi(false);
    // It would report a standard error that takes nothing on standard error, and panic.
    log.log_internal_errors(false).init();
}
