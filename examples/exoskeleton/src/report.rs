//! The report of a run: figures against limits, as JSON for programs and as a table for people.

mod limits;
mod table;

use serde::Serialize;

use crate::joint::PerJoint;
use crate::metrics::Metrics;
use crate::record::{Record, Stall};
pub use limits::LimitCheck;
pub use table::table;

/// How time passed in the run.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Serialize)]
#[serde(rename_all = "kebab-case")]
pub enum RunMode {
    /// Virtual time in one thread. Says nothing about real-time performance.
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

/// What other load on the host did to a run.
#[derive(Debug, Clone, PartialEq)]
pub struct Disturbance<'a> {
    /// Figures of the strides that the host did not disturb.
    undisturbed: &'a Metrics,
    /// Stalls of the host.
    stalls: &'a [Stall],
    /// Whether too few strides are left to be judged.
    too_few: bool,
    /// Whether it stalled while the drives became ready.
    at_start: bool,
    /// Whether it stalled between the death of a node and the return of assistance.
    at_fault: bool,
}

impl<'a> Disturbance<'a> {
    /// Of a run with these figures, with and without the strides that the host disturbed.
    #[must_use]
    pub fn of(record: &'a Record, all: &Metrics, undisturbed: &'a Metrics) -> Self {
        let hits = |from_s: f64, to_s: f64| {
            record.stalls.iter().any(|stall| stall.from_s <= to_s && stall.to_s >= from_s)
        };
        let ready = record.ready_s.iter().flatten().copied();
        let (first_s, last_s) = (ready.clone().fold(f64::INFINITY, f64::min), ready.fold(0.0, f64::max));
        let needed = (UNDISTURBED_SHARE_MIN * all.strides_counted).max(UNDISTURBED_MIN);
        let is_less = undisturbed.strides_counted + ROUNDING < all.strides_counted;
        Self {
            undisturbed,
            stalls: &record.stalls,
            too_few: is_less && undisturbed.strides_counted < needed,
            at_start: hits(first_s - BEFORE_READY_S, last_s),
            at_fault: all.fault.as_ref().is_some_and(|fault| {
                let back_s =
                    fault.outage.to_s.zip(fault.resumed_after_s).map(|(to_s, after_s)| to_s + after_s);
                hits(fault.outage.from_s, back_s.unwrap_or(f64::INFINITY))
            }),
        }
    }
}

/// What a stall holds up shows so much later at most: a drive is ready when several processes have answered each other.
const BEFORE_READY_S: f64 = 0.1;
/// Share of the strides that has to be left for a judgement.
const UNDISTURBED_SHARE_MIN: f64 = 1.0 / 3.0;
/// Strides that have to be left for a judgement. A stride lacks its last millisecond.
const UNDISTURBED_MIN: f64 = 0.99;
/// Differences of sums of floating-point numbers, strides.
const ROUNDING: f64 = 1e-6;

/// What was run.
#[derive(Debug, Clone, PartialEq, Eq)]
pub struct RunDescription {
    /// How time passed.
    pub mode: RunMode,
    /// Strides asked for.
    pub strides: u32,
    /// The seed.
    pub seed: u64,
    /// Name of the trial file; `None` for the built-in curves.
    pub trial: Option<String>,
    /// The kill asked for, as on the command line.
    pub kill: Option<String>,
}

/// Percentiles of a time, microseconds.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct PercentilesUs {
    /// Median.
    pub p50: f64,
    /// 99 %.
    pub p99: f64,
    /// 99.9 %.
    pub p999: f64,
    /// Greatest.
    pub max: f64,
}

/// Timing that only a real-time run can measure.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct MeasuredTiming {
    /// Period of the drives' ticks, microseconds.
    pub period_us: PercentilesUs,
    /// Age of the gait state when a drive uses it, microseconds.
    pub age_us: PercentilesUs,
    /// Ticks that came more than two milliseconds late.
    pub deadline_misses: u64,
    /// Ticks.
    pub ticks: u64,
    /// Wakes of the witness that came more than two milliseconds late.
    pub witness_misses: u64,
    /// Wakes of the witness.
    pub witness_wakes: u64,
}

/// A value per joint by name.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct ByJoint {
    /// Hip.
    pub hip: f64,
    /// Knee.
    pub knee: f64,
    /// Ankle.
    pub ankle: f64,
}

/// How the barrier went.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Barrier {
    /// Time from the first node's start until all drives were ready, seconds.
    pub held_s: Option<f64>,
    /// Time between the first and the last drive to be ready, ms.
    pub ready_skew_ms: Option<f64>,
    /// Greatest torque before the release, Nm.
    pub torque_before_release_nm: f64,
}

/// How a fault went.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct FaultReport {
    /// The node that was killed.
    pub node: String,
    /// When, seconds of the run.
    pub at_s: f64,
    /// When it ran again, seconds of the run.
    pub back_at_s: Option<f64>,
    /// Time until all other drives damped, ms.
    pub all_safe_after_ms: Option<f64>,
    /// Time from its return until assistance was allowed again, seconds.
    pub resumed_after_s: Option<f64>,
    /// Greatest deviation from the intended angle meanwhile, degrees.
    pub deviation_max_deg: ByJoint,
}

/// The report.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Report {
    /// How time passed.
    pub mode: RunMode,
    /// Strides walked.
    pub strides: u32,
    /// Strides that count for the figures.
    pub strides_counted: f64,
    /// The seed.
    pub seed: u64,
    /// The trial file, if one was walked.
    pub trial: Option<String>,
    /// The kill, if one was asked for.
    pub kill: Option<String>,
    /// RMS of the angle against the reference at the estimated phase, degrees.
    pub rms_deg: ByJoint,
    /// RMS of the angle against the person's intention, degrees.
    pub rms_intended_deg: ByJoint,
    /// RMS of the phase error, per cent.
    pub phase_rms_percent: f64,
    /// Greatest phase error, per cent.
    pub phase_max_percent: f64,
    /// Work into the leg, J per stride.
    pub work_positive_j_per_stride: ByJoint,
    /// Work out of the leg, J per stride.
    pub work_negative_j_per_stride: ByJoint,
    /// Greatest torque, Nm.
    pub torque_peak_nm: ByJoint,
    /// Time at the torque limit, per cent.
    pub saturation_percent: ByJoint,
    /// Fastest change of the commanded torque, Nm/s.
    pub torque_rate_max_nm_s: f64,
    /// Strides until assistance was first allowed.
    pub assisted_from_stride: Option<f64>,
    /// Whether period, age and misses were measured; never in lock-step.
    pub timing_measured: bool,
    /// Period of the drives' ticks; `null` when not measured.
    pub period_us: Option<PercentilesUs>,
    /// Age of the gait state at its use; `null` when not measured.
    pub age_us: Option<PercentilesUs>,
    /// Ticks of the drives more than 2 ms late; `null` when not measured.
    pub deadline_misses: Option<u64>,
    /// Ticks of the drives; `null` when not measured.
    pub ticks: Option<u64>,
    /// Wakes of the witness, which only sleeps, more than 2 ms late; `null` when not measured.
    pub witness_misses: Option<u64>,
    /// Wakes of the witness; `null` when not measured.
    pub witness_wakes: Option<u64>,
    /// Strides that the limits were judged on: those that the host did not disturb, or all where too few are left.
    pub strides_judged: f64,
    /// Stalls of the host, seconds of the run.
    pub stalls: Vec<Stall>,
    /// The barrier.
    pub barrier: Barrier,
    /// The fault, if one was injected.
    pub fault: Option<FaultReport>,
    /// Each limit with what was expected and what was seen.
    pub limits: Vec<LimitCheck>,
    /// How the run ended.
    pub verdict: Verdict,
    /// Whether every limit held.
    pub passed: bool,
}

impl From<PerJoint<f64>> for ByJoint {
    fn from([hip, knee, ankle]: PerJoint<f64>) -> Self {
        Self { hip, knee, ankle }
    }
}

impl Report {
    /// The report on a run; `timing` only from a real-time run.
    #[must_use]
    pub fn of(run: &RunDescription, metrics: &Metrics, timing: Option<&MeasuredTiming>) -> Self {
        let undisturbed = Disturbance {
            undisturbed: metrics,
            stalls: &[],
            too_few: false,
            at_start: false,
            at_fault: false,
        };
        Self::of_disturbed(run, metrics, timing, &undisturbed)
    }

    /// The report on a run whose host may have disturbed it. Figures are those of all strides; limits on strides are judged on
    /// undisturbed ones.
    #[must_use]
    pub fn of_disturbed(
        run: &RunDescription,
        metrics: &Metrics,
        timing: Option<&MeasuredTiming>,
        disturbance: &Disturbance<'_>,
    ) -> Self {
        let judged = if disturbance.too_few { metrics } else { disturbance.undisturbed };
        let limits = limits::check(metrics, judged, disturbance, run);
        let verdict = limits::verdict(&limits);
        Self {
            mode: run.mode,
            strides: run.strides,
            strides_counted: metrics.strides_counted,
            seed: run.seed,
            trial: run.trial.clone(),
            kill: run.kill.clone(),
            rms_deg: metrics.rms_deg.into(),
            rms_intended_deg: metrics.rms_intended_deg.into(),
            phase_rms_percent: metrics.phase_rms_percent,
            phase_max_percent: metrics.phase_max_percent,
            work_positive_j_per_stride: metrics.work_positive_j_per_stride.into(),
            work_negative_j_per_stride: metrics.work_negative_j_per_stride.into(),
            torque_peak_nm: metrics.torque_peak_nm.into(),
            saturation_percent: metrics.saturation_percent.into(),
            torque_rate_max_nm_s: metrics.torque_rate_max_nm_s,
            assisted_from_stride: metrics.assisted_from_stride,
            timing_measured: timing.is_some(),
            period_us: timing.map(|t| t.period_us),
            age_us: timing.map(|t| t.age_us),
            deadline_misses: timing.map(|t| t.deadline_misses),
            ticks: timing.map(|t| t.ticks),
            witness_misses: timing.map(|t| t.witness_misses),
            witness_wakes: timing.map(|t| t.witness_wakes),
            strides_judged: judged.strides_counted,
            stalls: disturbance.stalls.to_vec(),
            barrier: Barrier {
                held_s: metrics.barrier_held_s,
                ready_skew_ms: metrics.ready_skew_ms,
                torque_before_release_nm: metrics.torque_before_release_nm,
            },
            fault: metrics.fault.as_ref().map(FaultReport::of),
            verdict,
            passed: verdict == Verdict::Passed,
            limits,
        }
    }
}

impl FaultReport {
    fn of(fault: &crate::metrics::FaultFigures) -> Self {
        Self {
            node: fault.outage.part.name().to_owned(),
            at_s: fault.outage.from_s,
            back_at_s: fault.outage.to_s,
            all_safe_after_ms: fault.all_safe_after_ms,
            resumed_after_s: fault.resumed_after_s,
            deviation_max_deg: fault.deviation_max_deg.into(),
        }
    }
}
