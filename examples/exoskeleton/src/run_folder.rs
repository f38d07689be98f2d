//! The output of a run: the table, and a folder with `report.json`, `run.csv` and `gait.svg`.

use std::fs;
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};

use exoskeleton_model::record::Record;
use exoskeleton_recording::plot::{Figure, Lateness, figure};

use crate::report::{Report, RunDescription, RunMode, Verdict};

/// Writes the three files into `folder`, which is created if needed, and the report also to `report_too`.
///
/// # Errors
/// The system's error, with the path of its file.
pub fn write(
    folder: &Path,
    report: &Report,
    record: &Record,
    lateness: Option<&Lateness>,
    report_too: Option<&Path>,
) -> io::Result<()> {
    let json = serde_json::to_string_pretty(report).map_err(io::Error::other)? + "\n";
    let (csv, svg) = (folder.join("run.csv"), folder.join("gait.svg"));
    let (title, caption) = (title(&report.run), caption(report));
    let text = figure(&Figure { record, title: &title, caption: &caption, lateness });
    let written = [
        fs::create_dir_all(folder).map_err(|error| at(folder, &error)),
        write_text(&folder.join("report.json"), &json),
        report_too.map_or(Ok(()), |path| write_text(path, &json)),
        fs::File::create(&csv)
            .and_then(|file| record.write_csv(BufWriter::new(file)))
            .map_err(|error| at(&csv, &error)),
        write_text(&svg, &text),
    ];
    // Each is tried: one that cannot be written does not prevent the others.
    written.into_iter().collect()
}

/// Writes a text to a file.
///
/// # Errors
/// The system's error, with the path of the file.
pub fn write_text(path: &Path, text: &str) -> io::Result<()> {
    fs::write(path, text).map_err(|error| at(path, &error))
}

/// An error of the system, with the path of its file or folder.
fn at(path: &Path, error: &io::Error) -> io::Error {
    io::Error::new(error.kind(), format!("cannot write {}: {error}", path.display()))
}

/// Name of the folder: the same run in virtual time writes to the same place.
#[must_use]
pub fn name(run: &RunDescription) -> String {
    let mode = match run.mode {
        RunMode::LockStep => "lock-step",
        RunMode::RealTime => "real-time",
    };
    let source = if run.trial.is_some() { "trial" } else { "curves" };
    let kill =
        run.kill.as_deref().map(|kill| format!("-kill-{}", kill.replace('@', "-at-"))).unwrap_or_default();
    format!("{mode}-{source}-seed{}-{}strides{kill}", run.seed, run.strides)
}

/// Creates a folder that no other run has: no two real-time runs are the same.
///
/// # Errors
/// The system's error, with the path of the folder.
pub fn create(runs: &Path, name: &str) -> io::Result<PathBuf> {
    /// Runs of the same kind in one folder.
    const RUNS_MAX: u32 = 10_000;
    fs::create_dir_all(runs).map_err(|error| at(runs, &error))?;
    for number in 1..=RUNS_MAX {
        let folder = runs.join(format!("{name}-{number}"));
        match fs::create_dir(&folder) {
            Ok(()) => return std::path::absolute(folder),
            Err(error) if error.kind() == io::ErrorKind::AlreadyExists => {}
            Err(error) => return Err(at(&folder, &error)),
        }
    }
    Err(io::Error::other(format!("{} holds {RUNS_MAX} runs of this kind; remove some", runs.display())))
}

fn title(run: &RunDescription) -> String {
    let source = run.trial.as_deref().unwrap_or("built-in curves");
    format!("Powered leg: {} strides, {source}, seed {}", run.strides, run.seed)
}

fn caption(report: &Report) -> String {
    let mode = match report.run.mode {
        RunMode::LockStep => "Lock-step in virtual time (no real-time figures).",
        RunMode::RealTime => "Real time.",
    };
    let figures = &report.figures;
    let [hip, knee, ankle] = figures.rms_deg;
    format!(
        "{mode} RMS to reference {hip:.2} / {knee:.2} / {ankle:.2} deg (hip / knee / ankle); phase RMS {:.2} %; \
         work into the leg {:.1} J per stride; limits {}.",
        figures.phase_rms_percent,
        figures.work_positive_j_per_stride.iter().sum::<f64>(),
        match report.verdict {
            Verdict::Passed => "held",
            Verdict::Failed => "NOT held",
            Verdict::Inconclusive => "not judged: the host stalled",
        }
    )
}
