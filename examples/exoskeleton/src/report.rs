//! The report of a run: figures against limits, as JSON for programs and as a table for people.

mod limits;
mod real_time;
mod table;

use exoskeleton_model::metrics::Metrics;
use exoskeleton_model::record::{Record, Stall};
use serde::Serialize;

pub use limits::LimitCheck;
pub use real_time::{
    HostFigures, KillFigures, LoopSummary, PercentilesUs, RealTimeFigures, UnstalledFigures,
};
pub use table::table;

/// The kind of time in the run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum RunMode {
    /// Virtual time in one thread. Shows nothing about real-time performance.
    LockStep,
    /// Wall-clock time over processes.
    RealTime,
}

/// How a run ended.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum Verdict {
    /// All limits held.
    Passed,
    /// A limit did not hold.
    Failed,
    /// The host disturbed the run where a limit did not hold: it cannot be judged.
    Inconclusive,
}

/// The effect of other load on the host on a run.
#[derive(Debug, Clone, PartialEq)]
struct Disturbance {
    /// Figures of the strides that the host did not disturb.
    undisturbed: Metrics,
    /// Whether too few strides are left to be judged.
    too_few: bool,
    /// Whether it stalled while the drives became ready.
    at_start: bool,
    /// Whether it stalled between the death of a node and the return of assistance.
    at_fault: bool,
}

impl Disturbance {
    /// Computes this for a run with these figures of all strides and of the undisturbed ones.
    fn of(record: &Record, all: &Metrics, undisturbed: Metrics) -> Self {
        let hits = |from_s: f64, to_s: f64| {
            record.stalls.iter().any(|stall| stall.from_s <= to_s && stall.to_s >= from_s)
        };
        let ready = record.ready_s.iter().flatten().copied();
        let (first_s, last_s) = (ready.clone().fold(f64::INFINITY, f64::min), ready.fold(0.0, f64::max));
        let needed = (UNDISTURBED_SHARE_MIN * all.strides_counted).max(UNDISTURBED_MIN);
        let is_less = undisturbed.strides_counted + ROUNDING < all.strides_counted;
        Self {
            too_few: is_less && undisturbed.strides_counted < needed,
            undisturbed,
            at_start: hits(first_s - BEFORE_READY_S, last_s),
            at_fault: all.fault.as_ref().is_some_and(|fault| {
                let back_s =
                    fault.outage.to_s.zip(fault.resumed_after_s).map(|(to_s, after_s)| to_s + after_s);
                hits(fault.outage.from_s, back_s.unwrap_or(f64::INFINITY))
            }),
        }
    }
}

/// Maximum delay of a stall's effect: a drive is ready when several processes have answered each other.
const BEFORE_READY_S: f64 = 0.1;
/// Share of the strides that must be left for a judgement. On a host that disturbs more of them, the rest had
/// its shorter stalls, too: of 20 runs beside a load two broke a limit, by 2 % with 36 % of the strides left
/// and by 1 % with half of them.
const UNDISTURBED_SHARE_MIN: f64 = 0.75;
/// Strides that must be left for a judgement. A stride lacks its last millisecond.
const UNDISTURBED_MIN: f64 = 0.99;
/// Differences of sums of floating-point numbers, strides.
const ROUNDING: f64 = 1e-6;

/// Description of the run.
#[derive(Debug, Clone, PartialEq, Eq, Serialize)]
pub struct RunDescription {
    /// The kind of time in the run.
    pub mode: RunMode,
    /// Strides requested.
    pub strides: u32,
    /// The seed.
    pub seed: u64,
    /// Name of the trial file; `None` for the built-in curves.
    pub trial: Option<String>,
    /// The requested kill, as on the command line.
    pub kill: Option<String>,
}

/// Timing that only a real-time run can measure; all `None` in virtual time.
#[derive(Debug, Clone, Copy, PartialEq, Default, Serialize)]
pub struct Timing {
    /// Whether the rest was measured.
    pub timing_measured: bool,
    /// Period of the drives' ticks.
    pub period_us: Option<PercentilesUs>,
    /// Age of the gait state when a drive uses it.
    pub age_us: Option<PercentilesUs>,
    /// Ticks of the drives that came more than 2 ms late.
    pub deadline_misses: Option<u64>,
    /// Ticks of the drives.
    pub ticks: Option<u64>,
    /// Wakes of the witness, which only sleeps, that came more than 2 ms late.
    pub witness_misses: Option<u64>,
    /// Wakes of the witness.
    pub witness_wakes: Option<u64>,
}

/// The report.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// The run.
    #[serde(flatten)]
    pub run: RunDescription,
    /// The figures of all strides.
    #[serde(flatten)]
    pub figures: Metrics,
    /// The timing, if it was measured.
    #[serde(flatten)]
    pub timing: Timing,
    /// Strides on which the limits were judged: those that the host did not disturb, or all if too few are
    /// left.
    pub strides_judged: f64,
    /// Stalls of the host, seconds of the run.
    pub stalls: Vec<Stall>,
    /// Each limit with the expectation and the observation.
    pub limits: Vec<LimitCheck>,
    /// How the run ended.
    pub verdict: Verdict,
    /// Whether every limit held.
    pub passed: bool,
    /// Figures of real-time runs only.
    #[serde(skip_serializing_if = "Option::is_none")]
    pub real_time: Option<RealTimeFigures>,
}

impl Report {
    /// The report on a run in virtual time.
    #[must_use]
    pub fn of(run: RunDescription, record: &Record) -> Self {
        let figures = Metrics::of(record);
        Self::on(run, record, figures.clone(), figures)
    }

    /// The report on a run in real time. Figures are those of all strides; limits on strides are judged on
    /// those that the host did not disturb. `torque_rate_max_nm_s` is in the drives' own time, as the rows are
    /// the plant's milliseconds.
    #[must_use]
    pub fn of_real_time(
        run: RunDescription,
        record: &Record,
        torque_rate_max_nm_s: f64,
        timing: Timing,
        real_time: RealTimeFigures,
    ) -> Self {
        let [all, undisturbed] = [Metrics::of(record), Metrics::without_stalls(record)]
            .map(|metrics| Metrics { torque_rate_max_nm_s, ..metrics });
        Self { timing, real_time: Some(real_time), ..Self::on(run, record, all, undisturbed) }
    }

    fn on(run: RunDescription, record: &Record, figures: Metrics, undisturbed: Metrics) -> Self {
        let disturbance = Disturbance::of(record, &figures, undisturbed);
        let judged = if disturbance.too_few { &figures } else { &disturbance.undisturbed };
        let limits = limits::check(&figures, judged, &disturbance, &run);
        let verdict = limits::verdict(&limits);
        Self {
            strides_judged: judged.strides_counted,
            run,
            figures,
            timing: Timing::default(),
            stalls: record.stalls.clone(),
            limits,
            verdict,
            passed: verdict == Verdict::Passed,
            real_time: None,
        }
    }
}
