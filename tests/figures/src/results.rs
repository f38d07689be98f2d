//! Results of a bench as a file. The program `charts` (`benches/charts`) draws charts from such files.
//!
//! A file is one JSON object, a [`BenchRun`]: `machine`, `command`, `commit`, `date`, optionally a `note`, and
//! `results`. This list has one object, a [`CaseResult`], for each case, pace, pinning and size:
//!
//! | field | content |
//! | --- | --- |
//! | `case` | the path or carrier |
//! | `pace` | `back_to_back`, `1khz`, or `flood`: one way, as fast as possible |
//! | `cpus` | `anywhere`, `one_cpu` or `one_cpu_each` |
//! | `bytes` | payload of a message |
//! | `runs` | runs of this case in this file |
//! | `rounds` | recorded round trips of a run, or packets of a flood |
//! | `min_ns`, `p50_ns`, `p99_ns`, `p999_ns`, `max_ns` | times of a round trip, in nanoseconds |
//! | `per_second`, `least_per_second`, `most_per_second` | messages a second of a flood: median, least and most of its runs |
//!
//! A quantity that was not recorded is absent.

use std::{
    fs, io,
    path::{Path, PathBuf},
    process::Command,
};

use serde::{Deserialize, Serialize};

use crate::{Figures, hardware};

/// The pace of a flood. The other paces are those of [`Pace`](crate::Pace).
pub const FLOOD: &str = "flood";

/// One run of a bench.
#[derive(Clone, Debug, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct BenchRun {
    /// CPUs, model and kernel.
    pub machine: String,
    /// The command that repeats the run.
    pub command: String,
    /// The measured commit, with `-dirty` if files were changed.
    pub commit: String,
    /// The day of the run (UTC): `2026-11-30`.
    pub date: String,
    /// A remark for readers of the file.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub note: Option<String>,
    /// The results.
    pub results: Vec<CaseResult>,
}

/// The result of one case.
#[derive(Clone, Debug, Default, PartialEq, Eq, Serialize, Deserialize)]
#[serde(deny_unknown_fields)]
pub struct CaseResult {
    /// Name of the path or carrier.
    pub case: String,
    /// Name of the pace.
    pub pace: String,
    /// Name of the pinning.
    pub cpus: String,
    /// Payload of a message, in bytes.
    pub bytes: usize,
    /// Runs of this case.
    pub runs: usize,
    /// Recorded round trips of a run, or packets.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub rounds: Option<u64>,
    /// The least time, in nanoseconds.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub min_ns: Option<u64>,
    /// The median.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub p50_ns: Option<u64>,
    /// The 99th percentile.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub p99_ns: Option<u64>,
    /// The 99.9th percentile.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub p999_ns: Option<u64>,
    /// The maximum.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub max_ns: Option<u64>,
    /// Messages per second of a flood: the median of its runs.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub per_second: Option<u64>,
    /// The slowest run of a flood.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub least_per_second: Option<u64>,
    /// The fastest run of a flood.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub most_per_second: Option<u64>,
}

impl CaseResult {
    /// The result of a case with these times of round trips.
    #[must_use]
    pub fn of_times(case: &str, pace: &str, cpus: &str, bytes: usize, seen: &Figures) -> Self {
        let quantile = |quantile| Some(seen.0.value_at_quantile(quantile));
        Self {
            case: case.to_owned(),
            pace: pace.to_owned(),
            cpus: cpus.to_owned(),
            bytes,
            runs: 1,
            rounds: Some(seen.rounds()),
            min_ns: Some(seen.0.min()),
            p50_ns: quantile(0.5),
            p99_ns: quantile(0.99),
            p999_ns: quantile(0.999),
            max_ns: Some(seen.0.max()),
            ..Self::default()
        }
    }
}

impl BenchRun {
    /// A run of `command` at this time on this machine, without results.
    fn here(command: String) -> Self {
        let folder = env!("CARGO_MANIFEST_DIR");
        let commit = ["-C", folder, "describe", "--always", "--dirty", "--exclude", "*"];
        Self {
            machine: hardware(),
            command,
            commit: output("git", &commit),
            date: output("date", &["--utc", "+%F"]),
            note: None,
            results: Vec::new(),
        }
    }

    /// Reads a file.
    ///
    /// # Errors
    /// The file cannot be read, or has another format.
    pub fn read(path: &Path) -> Result<Self, String> {
        let text = fs::read_to_string(path).map_err(|why| format!("{}: {why}", path.display()))?;
        serde_json::from_str(&text).map_err(|why| format!("{}: {why}", path.display()))
    }

    fn write(&self, path: &Path) -> io::Result<()> {
        fs::write(path, serde_json::to_string_pretty(self)? + "\n")
    }
}

/// Returns the output of a program, or `unknown`.
fn output(program: &str, arguments: &[&str]) -> String {
    let output = Command::new(program).args(arguments).output().ok().filter(|output| output.status.success());
    let text = output.and_then(|output| String::from_utf8(output.stdout).ok());
    text.map_or_else(|| "unknown".to_owned(), |text| text.trim().to_owned())
}

/// Collects the results of a running bench, for its file.
#[derive(Debug)]
pub struct Recorder {
    path: Option<PathBuf>,
    run: BenchRun,
}

impl Recorder {
    /// A recorder for this file. Without a path nothing is written.
    ///
    /// # Errors
    /// The file cannot be written. This is tried before the bench takes its time.
    pub fn start(path: Option<PathBuf>, command: String) -> io::Result<Self> {
        let run = BenchRun::here(command);
        if let Some(path) = &path {
            run.write(path)?;
        }
        Ok(Self { path, run })
    }

    /// Adds a result.
    pub fn add(&mut self, result: CaseResult) {
        self.run.results.push(result);
    }

    /// Writes the file.
    ///
    /// # Errors
    /// The file cannot be written.
    pub fn finish(self) -> io::Result<()> {
        self.path.map_or(Ok(()), |path| self.run.write(&path))
    }
}

#[cfg(test)]
mod tests {
    use std::time::Duration;

    use super::*;

    fn times() -> Figures {
        let mut figures = Figures::new();
        (1..=1_000).for_each(|micros| figures.record(Duration::from_micros(micros)));
        figures
    }

    #[test]
    fn recorded_results_are_read_back() {
        let path = std::env::temp_dir().join(format!("sinew-results-{}.json", std::process::id()));
        let mut recorder = Recorder::start(Some(path.clone()), "bench".to_owned()).unwrap();
        assert_eq!(BenchRun::read(&path).unwrap().results, []);
        let result = CaseResult::of_times("direct", "1khz", "one_cpu", 1_000, &times());
        recorder.add(result.clone());
        recorder.finish().unwrap();
        let read = BenchRun::read(&path).unwrap();
        fs::remove_file(&path).unwrap();
        assert_eq!((read.command.as_str(), read.results), ("bench", vec![result]));
    }

    #[test]
    fn times_are_nanoseconds() {
        let result = CaseResult::of_times("direct", "1khz", "one_cpu", 1_000, &times());
        let is_near = |seen: Option<u64>, wanted: u64| seen.unwrap().abs_diff(wanted) <= wanted / 500;
        assert!(is_near(result.min_ns, 1_000), "{result:?}");
        assert!(is_near(result.p50_ns, 500_000), "{result:?}");
        assert!(is_near(result.p999_ns, 999_000), "{result:?}");
        assert!(is_near(result.max_ns, 1_000_000), "{result:?}");
    }

    #[test]
    fn unwritable_file_is_an_error_at_once() {
        assert!(Recorder::start(Some("/nowhere/at/all.json".into()), String::new()).is_err());
    }

    #[test]
    fn unknown_field_is_an_error() {
        let path = std::env::temp_dir().join(format!("sinew-results-{}-odd.json", std::process::id()));
        fs::write(&path, r#"{"machine":"","command":"","commit":"","date":"","results":[],"odd":1}"#)
            .unwrap();
        let why = BenchRun::read(&path).unwrap_err();
        fs::remove_file(&path).unwrap();
        assert!(why.contains("odd"), "{why}");
    }
}
