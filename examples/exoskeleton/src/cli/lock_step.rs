//! A run in virtual time from the command line.

use std::sync::Arc;

use super::{Arguments, RunError, Verdict};
use exoskeleton::gait::trial::Trial;
use exoskeleton::intention::Intention;
use exoskeleton::lockstep::{self, LockStepConfig};
use exoskeleton::metrics::Metrics;
use exoskeleton::report::{self, Report, RunDescription, RunMode};
use exoskeleton::run_folder;

/// Runs, prints the table, writes the folder.
pub(super) fn run(arguments: &Arguments) -> Result<Verdict, RunError> {
    let mut config = LockStepConfig::standard(arguments.strides, arguments.seed, intention(arguments)?);
    config.kill = arguments.kill;
    config.plant.watchdog_ns = arguments.device_watchdog.map(|ms| ms * 1_000_000);
    let record = lockstep::run(&config)?;
    let report = Report::of(&description(arguments), &Metrics::of(&record), None);
    print!("{}", report::table(&report));
    let folder = arguments.runs.join(run_folder::name(&report));
    run_folder::write(&folder, &report, &record, None)?;
    if let Some(path) = &arguments.report {
        run_folder::write_report(path, &report)?;
    }
    println!("written: {}/ gait.svg, run.csv, report.json", folder.display());
    Ok(if report.passed { Verdict::LimitsHeld } else { Verdict::LimitBroken })
}

fn intention(arguments: &Arguments) -> Result<Intention, RunError> {
    let Some(path) = &arguments.trial else { return Ok(Intention::from_curves(arguments.seed)) };
    let trial =
        Trial::read(path).map_err(|reason| RunError::Trial { path: path.display().to_string(), reason })?;
    Ok(Intention::from_trial(Arc::new(trial)))
}

fn description(arguments: &Arguments) -> RunDescription {
    let file_name = |path: &std::path::PathBuf| {
        path.file_name()
            .map_or_else(|| path.display().to_string(), |name| name.to_string_lossy().into_owned())
    };
    RunDescription {
        mode: RunMode::LockStep,
        strides: arguments.strides,
        seed: arguments.seed,
        trial: arguments.trial.as_ref().map(file_name),
        kill: arguments.kill.map(|kill| kill.to_string()),
    }
}
