//! Several runs of a bench on one machine, merged.

use sinew_figures::results::{BenchRun, CaseResult, FLOOD};

/// Payload of the shown cases, in bytes.
pub(crate) const BYTES: usize = 1_000;

/// Runs of one machine.
#[derive(Debug)]
pub(crate) struct Merged(Vec<BenchRun>);

/// A figure over several runs.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Summary {
    pub(crate) least: u64,
    pub(crate) median: u64,
    /// Number of runs that have the figure.
    pub(crate) runs: usize,
}

/// A case of the shown payload.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Case<'a> {
    pub(crate) name: &'a str,
    pub(crate) pace: &'a str,
    pub(crate) cpus: &'a str,
}

impl Merged {
    /// Merges runs.
    ///
    /// # Errors
    /// There are no runs, or they are of several machines.
    pub(crate) fn new(runs: Vec<BenchRun>) -> Result<Self, String> {
        let Some(first) = runs.first() else { return Err("there are no files of results".to_owned()) };
        match runs.iter().find(|run| run.machine != first.machine) {
            Some(other) => Err(format!(
                "results of different machines, `{}` and `{}`: name the files of one of them",
                first.machine, other.machine
            )),
            None => Ok(Self(runs)),
        }
    }

    /// The median round trip of a case, in nanoseconds.
    pub(crate) fn p50(&self, case: Case<'_>) -> Option<Summary> {
        Summary::of(self.values(case, |result| result.p50_ns))
    }

    /// The 99.9th percentile of a case, in nanoseconds.
    pub(crate) fn p999(&self, case: Case<'_>) -> Option<Summary> {
        Summary::of(self.values(case, |result| result.p999_ns))
    }

    /// The messages per second of a flood. The least is that of the slowest flood of all runs.
    pub(crate) fn rate(&self, name: &str, cpus: &str) -> Option<Summary> {
        let case = Case { name, pace: FLOOD, cpus };
        let medians = Summary::of(self.values(case, |result| result.per_second))?;
        let least = self.values(case, |result| result.least_per_second).into_iter().min();
        Some(Summary { least: least.unwrap_or(medians.least), ..medians })
    }

    fn values(&self, case: Case<'_>, figure: impl Fn(&CaseResult) -> Option<u64>) -> Vec<u64> {
        let results = self.0.iter().flat_map(|run| &run.results);
        let same = results.filter(|result| {
            (result.case.as_str(), result.pace.as_str(), result.cpus.as_str(), result.bytes)
                == (case.name, case.pace, case.cpus, BYTES)
        });
        same.filter_map(figure).collect()
    }

    /// The machine, the commands, the days and the commits, a line each.
    pub(crate) fn caption(&self) -> Vec<String> {
        let runs = match self.0.len() {
            1 => "one run".to_owned(),
            many => format!("{many} runs, median (least)"),
        };
        let (days, commits) = (self.distinct(|run| &run.date), self.distinct(|run| &run.commit));
        vec![
            self.0[0].machine.clone(),
            self.distinct(|run| &run.command),
            format!("{days}, commit {commits}, {runs}"),
        ]
    }

    fn distinct(&self, field: impl Fn(&BenchRun) -> &String) -> String {
        let mut all: Vec<&str> = self.0.iter().map(|run| field(run).as_str()).collect();
        all.dedup();
        all.join("; ")
    }
}

impl Summary {
    fn of(mut values: Vec<u64>) -> Option<Self> {
        values.sort_unstable();
        let (least, runs) = (*values.first()?, values.len());
        let median = u64::midpoint(values[(runs - 1) / 2], values[runs / 2]);
        Some(Self { least, median, runs })
    }
}

#[cfg(test)]
pub(crate) mod tests {
    use super::*;

    const CASE: Case<'_> = Case { name: "zenoh", pace: "1khz", cpus: "one_cpu" };

    /// Returns a run of a machine with one result.
    pub(crate) fn run(machine: &str, result: CaseResult) -> BenchRun {
        BenchRun {
            machine: machine.to_owned(),
            command: "bench".to_owned(),
            commit: "c0ffee".to_owned(),
            date: "2026-11-30".to_owned(),
            note: None,
            results: vec![result],
        }
    }

    fn took(p50_ns: u64) -> BenchRun {
        let [case, pace, cpus] = [CASE.name, CASE.pace, CASE.cpus].map(str::to_owned);
        run("M", CaseResult { case, pace, cpus, bytes: BYTES, p50_ns: Some(p50_ns), ..CaseResult::default() })
    }

    fn rate(median: u64, least: u64) -> BenchRun {
        let [case, pace, cpus] = ["zenoh", FLOOD, "one_cpu"].map(str::to_owned);
        let (per_second, least_per_second) = (Some(median), Some(least));
        let result = CaseResult {
            case,
            pace,
            cpus,
            bytes: BYTES,
            per_second,
            least_per_second,
            ..CaseResult::default()
        };
        run("M", result)
    }

    #[test]
    fn figure_is_the_median_of_the_lowest_runs() {
        let of = |times: &[u64]| Merged::new(times.iter().copied().map(took).collect()).unwrap().p50(CASE);
        assert_eq!(of(&[30, 10, 20]), Some(Summary { least: 10, median: 20, runs: 3 }));
        assert_eq!(of(&[30, 10]), Some(Summary { least: 10, median: 20, runs: 2 }));
        let merged = Merged::new(vec![took(30)]).unwrap();
        assert_eq!(merged.p999(CASE), None);
        assert_eq!(merged.p50(Case { cpus: "one_cpu_each", ..CASE }), None);
        assert_eq!(merged.rate(CASE.name, CASE.cpus), None);
    }

    #[test]
    fn least_rate_is_that_of_the_slowest_flood() {
        let merged = Merged::new(vec![rate(100, 90), rate(110, 70)]).unwrap();
        assert_eq!(merged.rate("zenoh", "one_cpu"), Some(Summary { least: 70, median: 105, runs: 2 }));
    }

    #[test]
    fn machines_are_not_mixed() {
        let runs = vec![run("M", CaseResult::default()), run("N", CaseResult::default())];
        assert!(Merged::new(runs).unwrap_err().contains("`M` and `N`"));
        assert!(Merged::new(Vec::new()).is_err());
    }

    #[test]
    fn caption_names_machine_command_day_and_commit() {
        let mut second = took(2);
        second.commit = "decade".to_owned();
        let merged = Merged::new(vec![took(1), second]).unwrap();
        assert_eq!(
            merged.caption(),
            ["M", "bench", "2026-11-30, commit c0ffee; decade, 2 runs, median (least)"]
        );
    }
}
