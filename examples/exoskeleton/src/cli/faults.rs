//! The faults of the demonstration from the command line.

use std::path::PathBuf;
use std::str::FromStr;
use std::time::Duration;

use exoskeleton::output;
use exoskeleton::report;
use exoskeleton::robot::launch::faults::{self, ContrastRun, FaultOptions, FaultReport, Step};

use super::{RunError, Verdict};

/// Injects the faults of steps 4 to 11 of the demonstration into a walking robot and says what came of them.
///
/// Five processes walk on this host until the phase is found and assistance has risen. Then one fault after the other
/// is injected at a phase of the stride, and the traces of all processes are held against what is claimed:
///
/// 4 kill -9 of the process of the knee's drive | 5 the same process hangs (SIGSTOP, SIGCONT) | 6 the knee's node is
/// pulled (SIGKILL) | 7 it returns | 8 e-stop (software, not a safety function) | 9 insane commands | 11 central is killed
///
/// Where root and network namespaces are to be had, 6 and 7 are done once more with the link of the knee's node, on a
/// second robot with a host for each process (link-down), and 10 with a third one, whose nodes' network loses and
/// delays packets; elsewhere the report says why not.
///
/// In the end the contrast: the ankle's drive hangs at push-off (SIGSTOP; a killed one would be back too soon to show it),
/// with and without a device watchdog; faults.svg in the run folder has both beside each other.
///
/// The table has what is expected of each class of machine: A real-time kernel and isolated core, B plain Linux and
/// idle, C any machine. Times are held against class C; what concerns function has to hold on every machine.
///
/// Exit code 0: everything held. 1: no robot walked. 2: an argument is wrong. 3: something did not hold.
#[derive(Debug, clap::Args)]
#[command(verbatim_doc_comment)]
pub(super) struct FaultArguments {
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
    /// For machines that others share: one phase, no link-down, no 10, the contrast in virtual time, and only what has to hold
    /// on every machine counts for the exit code.
    #[arg(long)]
    short: bool,
}

/// What can be asked for by itself.
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

/// Runs, prints the table, writes the report.
pub(super) fn run(arguments: &FaultArguments) -> Result<Verdict, RunError> {
    let report = faults::run(&options(arguments)?)?;
    output::print(&faults::table(&report.claims));
    let json = serde_json::to_string_pretty(&serde_json::json!({ "faults": report }))
        .map_err(std::io::Error::other)?
        + "\n";
    output::print(&words(&report));
    let in_folder = report.folder.join("report.json");
    let mut unwritten = None;
    // One that cannot be written takes no other away.
    for path in [Some(&in_folder), arguments.report.as_ref()].into_iter().flatten() {
        if let Err(error) = std::fs::write(path, &json) {
            unwritten.get_or_insert_with(|| super::at(path, &error));
        }
    }
    if let Some(error) = unwritten {
        return Err(error.into());
    }
    let held = if arguments.short { report.functional_held } else { report.passed };
    Ok(Verdict::Walked(if held { report::Verdict::Passed } else { report::Verdict::Failed }))
}

fn options(arguments: &FaultArguments) -> Result<FaultOptions, RunError> {
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
