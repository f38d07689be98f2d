//! Arguments, and which run they mean.

mod lock_step;

use std::path::PathBuf;

use clap::Parser;
use exoskeleton::gait::trial::TrialError;
use exoskeleton::lockstep::LockStepError;
use exoskeleton::part::Kill;
use thiserror::Error;

/// A powered leg of four nodes and a simulated person.
#[derive(Debug, Parser)]
#[command(version)]
pub(crate) struct Arguments {
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
    /// Folder for the run folders.
    #[arg(long, value_name = "DIR", default_value = "runs")]
    pub(crate) runs: PathBuf,
}

/// How a run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub(crate) enum Verdict {
    /// All limits held.
    LimitsHeld,
    /// At least one limit did not hold.
    LimitBroken,
}

/// Why there was no run.
#[derive(Debug, Error)]
pub(crate) enum RunError {
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
    /// Nothing runs in real time yet.
    #[error("the real-time run over five processes is not built yet; use --lock-step")]
    RealTimeMissing,
}

/// Does what the arguments say.
pub(crate) fn run(arguments: &Arguments) -> Result<Verdict, RunError> {
    if arguments.lock_step { lock_step::run(arguments) } else { Err(RunError::RealTimeMissing) }
}
