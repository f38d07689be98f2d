//! The command line of the robot under faults.

use std::io;
use std::path::PathBuf;
use std::process::ExitCode;
use std::str::FromStr;
use std::time::Duration;

use clap::{Parser, Subcommand};
use exoskeleton::output;
use exoskeleton::robot::node::{self, NodeError, NodeOptions};
use exoskeleton::run_folder;
use thiserror::Error;

use crate::campaign::{self, ContrastRun, FaultError, FaultOptions, FaultReport};
use crate::claim;
use crate::step::Step;

/// Injects the faults of steps 4 to 11 of the demonstration into a walking robot, and reports their effects.
///
/// Five processes walk on this host until the phase is found and assistance has risen. Then one fault after the other
/// is injected at a phase of the stride, and the traces of all processes are compared with the claims:
///
/// 4 kill -9 of the process of the knee's drive | 5 the same process hangs (SIGSTOP, SIGCONT) | 6 the knee's
/// node is pulled (SIGKILL) | 7 it returns | 8 e-stop (software, not a safety function) | 9 insane commands |
/// 11 central is killed
///
/// With root and network namespaces, 6 and 7 are repeated with the link of the knee's node, on a second robot with a
/// host for each process (link-down). 10 runs with a third robot, on a network that loses and delays packets. Without
/// them the report has the reason.
///
/// At the end the contrast: the ankle's drive hangs at push-off (SIGSTOP; a killed one would return too soon to show
/// it), with and without a device watchdog. faults.svg in the run folder has both beside each other.
///
/// The table has the expected values of each class of machine: A real-time kernel and isolated core, B plain Linux and
/// idle, C any machine. Times are compared with class C; functional claims have to hold on every machine.
///
/// Exit code 0: everything held. 1: no robot walked. 2: an argument is wrong. 3: something did not hold.
#[derive(Debug, Parser)]
#[command(version, verbatim_doc_comment, args_conflicts_with_subcommands = true)]
pub(crate) struct Arguments {
    #[command(subcommand)]
    command: Option<SubCommand>,
    /// Only these of 4, 5, 6, 7, 8, 9, 10, 11, link-down and contrast, for example 4,6,contrast.
    #[arg(long, value_delimiter = ',', value_name = "STEPS")]
    only: Vec<Item>,
    /// Phases of the stride at which the knee's drive is killed, 0 to 1.
    #[arg(long, value_delimiter = ',', value_name = "PHASES", default_value = "0.12,0.40,0.62,0.75")]
    phases: Vec<f64>,
    /// Seed of stride variation and sensor noise.
    #[arg(long, default_value_t = 1)]
    seed: u64,
    /// Folder for the run folders.
    #[arg(long, value_name = "DIR", default_value = "runs")]
    runs: PathBuf,
    /// Write the report as JSON to this file too.
    #[arg(long, value_name = "FILE")]
    report: Option<PathBuf>,
    /// Silence after which a device damps by itself, ms.
    #[arg(long, value_name = "MS", default_value_t = 8, value_parser = clap::value_parser!(u64).range(1..=10_000))]
    device_watchdog: u64,
    /// For shared machines: one phase, no link-down, no 10, the contrast in virtual time, and only functional
    /// claims count for the exit code.
    #[arg(long)]
    short: bool,
}

#[derive(Debug, Subcommand)]
enum SubCommand {
    /// Runs one part of a robot under faults: for this program itself.
    #[command(hide = true)]
    Node(NodeOptions),
}

/// The reason why there was no report.
#[derive(Debug, Error)]
pub(crate) enum RunError {
    /// The robot did not walk under faults.
    #[error(transparent)]
    Faults(#[from] FaultError),
    /// A part of the robot did not run.
    #[error(transparent)]
    Node(#[from] NodeError),
    /// A phase outside a stride.
    #[error("--phases {0}: a phase is at least 0 and less than 1")]
    Phase(f64),
    /// The report could not be written.
    #[error("{0}")]
    Write(#[from] io::Error),
}

/// A part of the demonstration that can be requested alone.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Item {
    Step(Step),
    LinkDown,
    RoughNetwork,
    Contrast,
}

impl FromStr for Item {
    type Err = String;

    fn from_str(text: &str) -> Result<Self, String> {
        match text.trim() {
            "contrast" => Ok(Self::Contrast),
            "link-down" => Ok(Self::LinkDown),
            "10" => Ok(Self::RoughNetwork),
            number => number.parse().map(Self::Step),
        }
    }
}

/// Runs, prints the table, writes the report; returns the exit code.
pub(crate) fn run(arguments: &Arguments) -> Result<ExitCode, RunError> {
    if let Some(SubCommand::Node(options)) = &arguments.command {
        return Ok(node::run(options)?);
    }
    let report = campaign::run(&options(arguments)?)?;
    output::print(&claim::table(&report.claims));
    let json = serde_json::to_string_pretty(&serde_json::json!({ "faults": report }))
        .map_err(io::Error::other)?
        + "\n";
    output::print(&words(&report));
    let in_folder = report.folder.join("report.json");
    let written = [Some(&in_folder), arguments.report.as_ref()]
        .map(|path| path.map_or(Ok(()), |path| run_folder::write_text(path, &json)));
    // An error in one file does not prevent the other.
    written.into_iter().collect::<io::Result<()>>()?;
    let held = if arguments.short { report.functional_held } else { report.passed };
    Ok(if held { ExitCode::SUCCESS } else { ExitCode::from(3) })
}

fn options(arguments: &Arguments) -> Result<FaultOptions, RunError> {
    let only = &arguments.only;
    let step = |item: &Item| match item {
        Item::Step(step) => Some(*step),
        Item::LinkDown | Item::RoughNetwork | Item::Contrast => None,
    };
    let steps = if only.is_empty() { Step::ALL.to_vec() } else { only.iter().filter_map(step).collect() };
    let with_contrast = only.is_empty() || only.contains(&Item::Contrast);
    if let Some(phase) = arguments.phases.iter().find(|phase| !(0.0..1.0).contains(*phase)) {
        return Err(RunError::Phase(*phase));
    }
    Ok(FaultOptions {
        steps,
        phases: if arguments.short { vec![0.62] } else { arguments.phases.clone() },
        seed: arguments.seed,
        device_watchdog: Duration::from_millis(arguments.device_watchdog),
        link_down: only.is_empty() && !arguments.short || only.contains(&Item::LinkDown),
        rough_network: only.is_empty() && !arguments.short || only.contains(&Item::RoughNetwork),
        contrast: with_contrast.then_some(if arguments.short {
            ContrastRun::LockStep
        } else {
            ContrastRun::RealTime
        }),
        runs: arguments.runs.clone(),
    })
}

fn words(report: &FaultReport) -> String {
    let mut text: String = report.skipped.iter().map(|words| format!("left out: {words}\n")).collect();
    text.extend(report.failures.iter().map(|words| format!("failed: {words}\n")));
    text.extend(
        report.claims.iter().filter(|claim| !claim.held).map(|claim| format!("did not hold: {claim}\n")),
    );
    let counted = |functional: bool| {
        let claims = || report.claims.iter().filter(|claim| claim.expected.is_functional() == functional);
        format!("{} of {}", claims().filter(|claim| claim.held).count(), claims().count())
    };
    let picture = if report.claims.iter().any(|claim| claim.step.is_none()) { "faults.svg, " } else { "" };
    text += &format!(
        "held: {} claims about function, {} times within class C\nwritten: {}/ {picture}report.json, and each \
         process's trace and log\n",
        counted(true),
        counted(false),
        report.folder.display()
    );
    text
}
