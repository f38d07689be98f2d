//! A run in virtual time from the command line.

use std::sync::Arc;

use super::{Arguments, RunError, Verdict};
use exoskeleton::gait::trial::Trial;
use exoskeleton::intention::Intention;
use exoskeleton::lockstep::{self, LockStepConfig};
use exoskeleton::metrics::Metrics;
use exoskeleton::output;
use exoskeleton::report::{self, Report, RunDescription, RunMode};
use exoskeleton::run_folder;

/// Runs, prints the table, writes the folder.
pub(super) fn run(arguments: &Arguments) -> Result<Verdict, RunError> {
    let intention = intention(arguments)?;
    intention.notes().iter().for_each(|note| output::print(&format!("--trial: {note}\n")));
    let mut config = LockStepConfig::standard(arguments.strides, arguments.seed, intention);
    config.kill = arguments.kill;
    config.plant.watchdog_ns = arguments.device_watchdog.map(|ms| ms * 1_000_000);
    let record = lockstep::run(&config)?;
    let report = Report::of(&description(arguments), &Metrics::of(&record), None);
    output::print(&report::table(&report));
    let folder = arguments.runs.join(run_folder::name(&report));
    let folder_written = run_folder::write(&folder, &report, &record, None);
    let report_written =
        arguments.report.as_ref().map_or(Ok(()), |path| run_folder::write_report(path, &report));
    // A folder that cannot be written takes no report away.
    folder_written?;
    report_written?;
    output::print(&format!("written: {}/ gait.svg, run.csv, report.json\n", folder.display()));
    Ok(Verdict::Walked(report.verdict))
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
