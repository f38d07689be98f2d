//! The report of a run: figures against limits, as JSON for programs and as a table for people.

mod limits;
mod table;

use serde::Serialize;

use crate::joint::PerJoint;
use crate::metrics::Metrics;
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
    /// Late ticks; `null` when not measured.
    pub deadline_misses: Option<u64>,
    /// The barrier.
    pub barrier: Barrier,
    /// The fault, if one was injected.
    pub fault: Option<FaultReport>,
    /// Each limit with what was expected and what was seen.
    pub limits: Vec<LimitCheck>,
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
        let limits = limits::check(metrics, run);
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
            barrier: Barrier {
                held_s: metrics.barrier_held_s,
                ready_skew_ms: metrics.ready_skew_ms,
                torque_before_release_nm: metrics.torque_before_release_nm,
            },
            fault: metrics.fault.as_ref().map(FaultReport::of),
            passed: limits.iter().all(|limit| limit.held),
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
