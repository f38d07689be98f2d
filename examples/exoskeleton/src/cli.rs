//! Arguments, and which run they mean.

mod faults;
mod lock_step;
mod node;
mod real_time;

use std::path::PathBuf;
use std::process::ExitCode;

use clap::{Parser, Subcommand};
use exoskeleton::gait::trial::TrialError;
use exoskeleton::lockstep::LockStepError;
use exoskeleton::part::Kill;
use exoskeleton::report;
use exoskeleton::robot::launch::LaunchError;
use exoskeleton::robot::launch::faults::FaultError;
use exoskeleton::robot::node::NodeError;
use thiserror::Error;

/// A powered leg of four nodes and a simulated person.
#[derive(Debug, Parser)]
#[command(version, args_conflicts_with_subcommands = true, after_help = EXIT_CODES)]
pub(crate) struct Arguments {
    /// One part alone, or the robot under faults, instead of a walk of the whole robot on this host.
    #[command(subcommand)]
    command: Option<SubCommand>,
    /// Virtual time in one thread, bit-identical for a seed; says nothing about real-time performance.
    #[arg(long)]
    pub(crate) lock_step: bool,
    /// Strides to walk; figures count from stride 7 on.
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u32).range(8..=5000))]
    pub(crate) strides: u32,
    /// Seed of stride variation and sensor noise.
    #[arg(long, default_value_t = 1)]
    pub(crate) seed: u64,
    /// A recorded trial (CSV) to walk instead of the built-in curves.
    #[arg(long, value_name = "FILE")]
    pub(crate) trial: Option<PathBuf>,
    /// Write the report as JSON to this file too.
    #[arg(long, value_name = "FILE")]
    pub(crate) report: Option<PathBuf>,
    /// Kill a node when a stride begins, for example knee@8, and start it again.
    #[arg(long, value_name = "NODE@STRIDE")]
    pub(crate) kill: Option<Kill>,
    /// Silence after which a device damps by itself, ms; without it a device holds its last torque.
    #[arg(long, value_name = "MS")]
    pub(crate) device_watchdog: Option<u64>,
    /// Thread of the control loops: `io`, which reads the sockets too, or `own`. Real time only.
    #[arg(long, value_name = "THREAD", default_value = "io", conflicts_with = "lock_step")]
    pub(crate) control_thread: real_time::ThreadArgument,
    /// `SCHED_FIFO` priority of the control loops, 1 to 89; wants `--control-thread own`. Real time only.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=89), conflicts_with = "lock_step")]
    pub(crate) realtime_priority: Option<u8>,
    /// Secure the links between nodes with the keys in this directory, made by `sinew keys init exoskeleton central=127.0.0.1 hip=127.0.0.2 knee=127.0.0.3
    /// ankle=127.0.0.4`. Real time only.
    #[arg(long, value_name = "DIR", conflicts_with = "lock_step")]
    pub(crate) keys: Option<PathBuf>,
    /// Folder for the run folders.
    #[arg(long, value_name = "DIR", default_value = "runs")]
    pub(crate) runs: PathBuf,
}

#[derive(Debug, Subcommand)]
enum SubCommand {
    /// Runs one part of the robot until SIGINT, SIGTERM or SIGHUP, so that it can be spread over several hosts.
    Node(node::NodeArguments),
    Faults(faults::FaultArguments),
}

const EXIT_CODES: &str = "\
Exit codes:
  0  all limits held
  1  it did not walk, or a result could not be written; the error says why
  2  the command line is wrong
  3  it walked, and a limit did not hold (FAILED); the table says which
  4  it walked, but other load on this host disturbed too many strides to judge them (INCONCLUSIVE); use an idle host, more strides,
     or --lock-step, which needs no real time";

/// How a run ended.
#[derive(Debug, Clone, Copy)]
pub(crate) enum Verdict {
    /// A robot walked.
    Walked(report::Verdict),
    /// One part ran alone and has ended.
    NodeEnded(ExitCode),
}

impl Verdict {
    /// The exit code; [`EXIT_CODES`] describes them.
    pub(crate) fn code(self) -> ExitCode {
        match self {
            Self::Walked(report::Verdict::Passed) => ExitCode::SUCCESS,
            Self::Walked(report::Verdict::Failed) => ExitCode::from(3),
            Self::Walked(report::Verdict::Inconclusive) => ExitCode::from(4),
            Self::NodeEnded(code) => code,
        }
    }
}

/// Why there was no run.
#[derive(Debug, Error)]
pub(crate) enum RunError {
    /// Too few strides are left after the kill.
    #[error(
        "--kill {kill}: assistance is back about six strides later and two more do not count, so --strides {strides} \
         leaves nothing to judge; ask for --strides {least} or kill earlier"
    )]
    KillTooLate {
        /// What was asked for.
        kill: String,
        /// Strides asked for.
        strides: u32,
        /// Strides that leave something to judge.
        least: u32,
    },
    /// The trial is not usable.
    #[error("--trial {path}: {reason}")]
    Trial {
        /// The path as given.
        path: String,
        /// Place and remedy.
        reason: TrialError,
    },
    /// The run could not be done.
    #[error(transparent)]
    LockStep(#[from] LockStepError),
    /// A result could not be written.
    #[error("{0}")]
    Write(#[from] std::io::Error),
    /// The robot walked, and its record could not be written.
    #[error("the record of this walk is incomplete: {0}")]
    Record(String),
    /// The robot did not walk in real time.
    #[error(transparent)]
    Launch(#[from] LaunchError),
    /// A part of the robot did not run.
    #[error(transparent)]
    Node(#[from] NodeError),
    /// The robot did not walk under faults.
    #[error(transparent)]
    Faults(#[from] FaultError),
    /// A phase that no stride has.
    #[error("--phases {0}: a phase is at least 0 and less than 1")]
    Phase(f64),
    /// A device watchdog of no use.
    #[error("--device-watchdog {0}: give 1 to 10000 ms, or leave it out for none")]
    Watchdog(u64),
}

/// Strides 1 to 6 never count; of the others those before the kill, and those two strides after assistance is back.
fn check_kill(arguments: &Arguments) -> Result<(), RunError> {
    let Some(kill) = &arguments.kill else { return Ok(()) };
    let least = kill.stride + 8;
    if kill.stride >= 8 && kill.stride < arguments.strides || arguments.strides >= least {
        return Ok(());
    }
    Err(RunError::KillTooLate { kill: kill.to_string(), strides: arguments.strides, least })
}

/// Does what the arguments say.
pub(crate) fn run(arguments: &Arguments) -> Result<Verdict, RunError> {
    check_kill(arguments)?;
    match &arguments.command {
        Some(SubCommand::Node(part)) => node::run(part),
        Some(SubCommand::Faults(arguments)) => faults::run(arguments),
        None if arguments.lock_step => lock_step::run(arguments),
        None => real_time::run(arguments),
    }
}

/// An error of the system, with the file it happened at.
fn at(path: &std::path::Path, error: &std::io::Error) -> std::io::Error {
    std::io::Error::new(error.kind(), format!("cannot write {}: {error}", path.display()))
}
