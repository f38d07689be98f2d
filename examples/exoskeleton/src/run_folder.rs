//! The folder a run leaves behind: `report.json`, `run.csv`, `gait.svg`.

use std::fs;
use std::io::{self, BufWriter};
use std::path::{Path, PathBuf};

use crate::plot::{Figure, Lateness, figure};
use crate::record::Record;
use crate::report::{Report, RunMode, Verdict};

/// Writes the three files into `folder`, which is made if needed; returns the folder.
///
/// # Errors
/// The system's error, with the path it happened at.
pub fn write(
    folder: &Path,
    report: &Report,
    record: &Record,
    lateness: Option<&Lateness>,
) -> io::Result<PathBuf> {
    fs::create_dir_all(folder).map_err(|e| at(folder, &e))?;
    let csv = folder.join("run.csv");
    let svg = folder.join("gait.svg");
    let (title, caption) = (title(report), caption(report));
    let text = figure(&Figure { record, title: &title, caption: &caption, lateness });
    let written = [
        write_report(&folder.join("report.json"), report),
        fs::File::create(&csv)
            .and_then(|file| record.write_csv(BufWriter::new(file)))
            .map_err(|e| at(&csv, &e)),
        fs::write(&svg, text).map_err(|e| at(&svg, &e)),
    ];
    // Each is tried: one that is too large for what is left of a disk takes no other away.
    written.into_iter().collect::<io::Result<()>>()?;
    Ok(folder.to_owned())
}

/// Writes the report alone, as JSON.
///
/// # Errors
/// The system's error, with the path it happened at.
pub fn write_report(path: &Path, report: &Report) -> io::Result<()> {
    let mut text = serde_json::to_string_pretty(report).map_err(io::Error::other)?;
    text.push('\n');
    fs::write(path, text).map_err(|e| at(path, &e))
}

/// Name of the folder: the same run writes to the same place.
#[must_use]
pub fn name(report: &Report) -> String {
    let mode = match report.mode {
        RunMode::LockStep => "lock-step",
        RunMode::RealTime => "real-time",
    };
    let source = if report.trial.is_some() { "trial" } else { "curves" };
    let kill =
        report.kill.as_deref().map(|kill| format!("-kill-{}", kill.replace('@', "-at-"))).unwrap_or_default();
    format!("{mode}-{source}-seed{}-{}strides{kill}", report.seed, report.strides)
}

fn title(report: &Report) -> String {
    let source = report.trial.as_deref().unwrap_or("built-in curves");
    format!("Powered leg: {} strides, {source}, seed {}", report.strides, report.seed)
}

fn caption(report: &Report) -> String {
    let mode = match report.mode {
        RunMode::LockStep => "Lock-step in virtual time (no real-time figures).",
        RunMode::RealTime => "Real time.",
    };
    let (rms, work) = (report.rms_deg, report.work_positive_j_per_stride);
    format!(
        "{mode} RMS to reference {:.2} / {:.2} / {:.2} deg (hip / knee / ankle); phase RMS {:.2} %; \
         work into the leg {:.1} J per stride; limits {}.",
        rms.hip,
        rms.knee,
        rms.ankle,
        report.phase_rms_percent,
        work.hip + work.knee + work.ankle,
        match report.verdict {
            Verdict::Passed => "held",
            Verdict::Failed => "NOT held",
            Verdict::Inconclusive => "not judged: the host stalled",
        }
    )
}

fn at(path: &Path, error: &io::Error) -> io::Error {
    io::Error::new(error.kind(), format!("cannot write {}: {error}", path.display()))
}
