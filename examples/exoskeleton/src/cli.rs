//! Command line arguments, and the run that they ask for.

use std::path::{Path, PathBuf};
use std::process::ExitCode;
use std::time::Duration;

use clap::{Parser, Subcommand};
use exoskeleton::output;
use exoskeleton::report::{self, Report, RunDescription, RunMode, Verdict};
use exoskeleton::robot::edges::{TICKS, drive_name};
use exoskeleton::robot::launch::{self, LaunchError, LaunchOptions};
use exoskeleton::robot::node::{self, NodeError, NodeOptions};
use exoskeleton::robot::plant::{self, PlantError};
use exoskeleton::robot::topology::{Control, ControlThread, ReleaseBy};
use exoskeleton::run_folder;
use exoskeleton_model::joint::Joint;
use exoskeleton_model::lockstep::{self, LockStepConfig, LockStepError};
use exoskeleton_model::part::Kill;
use exoskeleton_recording::replay::check_drive::{self, CheckDriveError};
use exoskeleton_recording::replay::{self, ReplayError};
use sinew::Tid;
use thiserror::Error;

/// A powered leg of four nodes and a simulated person.
#[derive(Debug, Parser)]
#[command(version, args_conflicts_with_subcommands = true, after_help = EXIT_CODES)]
pub(crate) struct Arguments {
    /// One part alone, instead of a walk of the whole robot on this host.
    #[command(subcommand)]
    command: Option<SubCommand>,
    /// Virtual time in one thread, bit-identical for a seed; says nothing about real-time performance.
    #[arg(long)]
    lock_step: bool,
    /// Strides to walk; figures count from stride 7 on.
    #[arg(long, default_value_t = 20, value_parser = clap::value_parser!(u32).range(8..=5000))]
    strides: u32,
    /// Seed of stride variation and sensor noise.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// A recorded trial (CSV) to walk instead of the built-in curves.
    #[arg(long, value_name = "FILE")]
    trial: Option<PathBuf>,
    /// Write the report as JSON to this file too.
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
    /// Kill a node when a stride begins, for example knee@8, and start it again.
    #[arg(long, value_name = "NODE@STRIDE")]
    kill: Option<Kill>,
    /// Silence after which a device damps by itself, ms; without it a device holds its last torque.
    #[arg(long, value_name = "MS")]
    device_watchdog: Option<u64>,
    /// Thread of the control loops: `io`, which reads the sockets too, or `own`. Real time only.
    #[arg(long, value_name = "THREAD", default_value = "io", conflicts_with = "lock_step")]
    control_thread: ControlThread,
    /// `SCHED_FIFO` priority of the control loops, 1 to 89; wants `--control-thread own`. Real time only.
    #[arg(long, value_name = "N", value_parser = clap::value_parser!(u8).range(1..=89), conflicts_with = "lock_step")]
    realtime_priority: Option<u8>,
    /// Secure the links between nodes with the keys in this directory, made by `sinew keys init exoskeleton
    /// central=127.0.0.1 hip=127.0.0.2 knee=127.0.0.3 ankle=127.0.0.4`. Real time only.
    #[arg(long, value_name = "DIR", conflicts_with = "lock_step")]
    keys: Option<PathBuf>,
    /// Folder for the run folders.
    #[arg(long, value_name = "DIR", default_value = "runs")]
    runs: PathBuf,
    /// Do not record the messages of the nodes, nor freeze those around faults. Real time only; in virtual time
    /// nothing is recorded.
    #[arg(long, conflicts_with = "lock_step")]
    no_record: bool,
    /// Compute the drives of a recorded walk again, from `walk.mcap` or the file of a joint's node, and compare their
    /// torques bit by bit. No walk.
    #[arg(long, value_name = "FILE", conflicts_with_all = ["lock_step", "trial", "report", "kill", "keys", "no_record"])]
    replay: Option<PathBuf>,
    /// Multiply assistance, stiffness and damping of the replayed drives, to see a difference.
    #[arg(long, value_name = "FACTOR", default_value_t = 1.0, requires = "replay")]
    gain_factor: f64,
}

#[derive(Debug, Subcommand)]
enum SubCommand {
    /// Runs one part of the robot until SIGINT, SIGTERM or SIGHUP, so that it can be spread over several hosts.
    Node(NodeOptions),
    /// Computes the drive of one joint again, on a recorded walk: run `sinew play --check walk.mcap --turns
    /// exo.drive_tick -- exoskeleton check-drive knee`.
    CheckDrive {
        /// hip, knee or ankle.
        #[arg(value_parser = joint)]
        joint: Joint,
        /// Multiply assistance, stiffness and damping, to see a difference.
        #[arg(long, value_name = "FACTOR", default_value_t = 1.0)]
        gain_factor: f64,
    },
}

/// Reads the name of a joint.
fn joint(text: &str) -> Result<Joint, String> {
    let found = Joint::ALL.into_iter().find(|joint| joint.name() == text);
    found.ok_or_else(|| "choose hip, knee or ankle".to_owned())
}

const EXIT_CODES: &str = "\
Exit codes:
  0  all limits held
  1  it did not walk, or a result could not be written; the error says why. With --replay: not every torque is the same
  2  the command line is wrong
  3  it walked, and a limit did not hold (FAILED); the table says which
  4  it walked, but other load on this host disturbed too many strides to judge them (INCONCLUSIVE); use an idle host, more strides,
     or --lock-step, which needs no real time";

/// The exit code of a walk; [`EXIT_CODES`] describes them.
fn code(verdict: Verdict) -> ExitCode {
    match verdict {
        Verdict::Passed => ExitCode::SUCCESS,
        Verdict::Failed => ExitCode::from(3),
        Verdict::Inconclusive => ExitCode::from(4),
    }
}

/// The reason why there was no run.
#[derive(Debug, Error)]
pub(crate) enum RunError {
    /// Too few strides are left after the kill.
    #[error(
        "--kill {kill}: assistance is back about six strides later and two more do not count, so --strides {strides} \
         leaves nothing to judge; ask for --strides {least} or kill earlier"
    )]
    KillTooLate {
        /// The requested kill.
        kill: String,
        /// Strides requested.
        strides: u32,
        /// Number of strides that leaves some to judge.
        least: u32,
    },
    /// The trial is not usable.
    #[error(transparent)]
    Trial(#[from] PlantError),
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
    /// A drive was not checked.
    #[error(transparent)]
    CheckDrive(#[from] CheckDriveError),
    /// The recording cannot be replayed.
    #[error("--replay: {0}")]
    Replay(#[from] ReplayError),
    /// A device watchdog without effect.
    #[error("--device-watchdog {0}: give 1 to 10000 ms, or leave it out for none")]
    Watchdog(u64),
}

/// Strides 1 to 6 never count; of the others those before the kill count, and those two strides after
/// assistance is back.
fn check_kill(arguments: &Arguments) -> Result<(), RunError> {
    let Some(kill) = &arguments.kill else { return Ok(()) };
    let least = kill.stride + 8;
    if kill.stride >= 8 && kill.stride < arguments.strides || arguments.strides >= least {
        return Ok(());
    }
    Err(RunError::KillTooLate { kill: kill.to_string(), strides: arguments.strides, least })
}

/// Runs the command of the arguments.
pub(crate) fn run(arguments: &Arguments) -> Result<ExitCode, RunError> {
    match &arguments.command {
        Some(SubCommand::Node(options)) => return Ok(node::run(options)?),
        Some(SubCommand::CheckDrive { joint, gain_factor }) => {
            let drive = replay::spec(drive_name(*joint), Tid::group(TICKS), *joint, *gain_factor);
            return Ok(check_drive::run(*joint, drive)?);
        }
        None => {}
    }
    if let Some(file) = &arguments.replay {
        return replay_drives(file, arguments.gain_factor);
    }
    check_kill(arguments)?;
    let verdict = if arguments.lock_step { lock_step(arguments) } else { real_time(arguments) };
    verdict.map(code)
}

/// Computes the drives of a recorded walk again, and prints the comparison.
fn replay_drives(file: &Path, gain_factor: f64) -> Result<ExitCode, RunError> {
    let replayed = replay::replay(file, gain_factor)?;
    output::print(&replayed.to_string());
    Ok(if replayed.is_same() { ExitCode::SUCCESS } else { ExitCode::FAILURE })
}

/// Walks in virtual time, prints the table, writes the folder.
fn lock_step(arguments: &Arguments) -> Result<Verdict, RunError> {
    let intention = plant::intention(arguments.trial.as_deref(), arguments.seed)?;
    intention.notes().iter().for_each(|note| output::print(&format!("--trial: {note}\n")));
    let mut config = LockStepConfig::standard(arguments.strides, arguments.seed, intention);
    config.kill = arguments.kill;
    config.plant.watchdog_ns = arguments.device_watchdog.map(|ms| ms * 1_000_000);
    let record = lockstep::run(&config)?;
    let report = Report::of(description(arguments), &record);
    output::print(&report::table(&report));
    let folder = arguments.runs.join(run_folder::name(&report.run));
    run_folder::write(&folder, &report, &record, None, arguments.report.as_deref())?;
    output::print(&format!("written: {}/ gait.svg, run.csv, report.json\n", folder.display()));
    Ok(report.verdict)
}

/// Starts the five processes, walks, prints the table, writes the folder.
fn real_time(arguments: &Arguments) -> Result<Verdict, RunError> {
    let walk = launch::run(&options(arguments)?)?;
    output::print(&report::table(&walk.report));
    output::print(&format!("{}\n", links(arguments.keys.as_deref())));
    let (report, record) = (&walk.report, &walk.record);
    run_folder::write(&walk.folder, report, record, Some(&walk.lateness), arguments.report.as_deref())
        .map_err(|error| RunError::Record(error.to_string()))?;
    output::print(&format!(
        "written: {}/ gait.svg, run.csv, report.json, and each process's trace and log\n",
        walk.folder.display()
    ));
    if let Some(recorded) = &walk.recorded {
        output::print(&recorded.to_string());
    }
    if let Some(frozen) = &walk.frozen {
        output::print(&frozen.to_string());
    }
    Ok(walk.report.verdict)
}

fn options(arguments: &Arguments) -> Result<LaunchOptions, RunError> {
    let device_watchdog = match arguments.device_watchdog {
        Some(ms) if !(1..=10_000).contains(&ms) => return Err(RunError::Watchdog(ms)),
        limit => limit.map(Duration::from_millis),
    };
    let (realtime_priority, release) = (arguments.realtime_priority, ReleaseBy::Itself);
    let thread = match arguments.control_thread {
        // The network must not run at a real-time priority.
        ControlThread::Io if realtime_priority.is_none() => ControlThread::Io,
        ControlThread::Io | ControlThread::Own => ControlThread::Own,
    };
    Ok(LaunchOptions {
        run: description(arguments),
        trial: arguments.trial.clone(),
        kill: arguments.kill,
        device_watchdog,
        control: Control { thread, realtime_priority, release, record: !arguments.no_record },
        keys: arguments.keys.clone(),
        runs: arguments.runs.clone(),
    })
}

fn description(arguments: &Arguments) -> RunDescription {
    let file_name = |path: &PathBuf| {
        path.file_name().map_or_else(|| path.to_string_lossy(), |name| name.to_string_lossy()).into_owned()
    };
    RunDescription {
        mode: if arguments.lock_step { RunMode::LockStep } else { RunMode::RealTime },
        strides: arguments.strides,
        seed: arguments.seed,
        trial: arguments.trial.as_ref().map(file_name),
        kill: arguments.kill.map(|kill| kill.to_string()),
    }
}

/// Describes the security of the links between nodes.
fn links(keys: Option<&Path>) -> String {
    let security = keys.map(|keys| keys.join("nodes")).map_or_else(
        || "open to every program of this host; `--keys DIR` closes them".to_owned(),
        |keys| {
            format!(
                "TLS 1.3, each node proven by its key in {}; those to the plant's devices are open",
                keys.display()
            )
        },
    );
    format!("links between nodes: {security}")
}
