//! The limits for a run: class C (any machine, functional) of steps 1 and 2 of the demonstration, and of the
//! fault steps when a node is killed.

use exoskeleton_model::joint::Joint;
use exoskeleton_model::metrics::Metrics;
use serde::Serialize;

use super::{Disturbance, RunDescription, Verdict};

/// Largest RMS against the reference, degrees: hip, knee, ankle.
const RMS_MAX_DEG: [f64; 3] = [2.0, 2.5, 3.0];
const PHASE_RMS_MAX_PERCENT: f64 = 3.0;
const WORK_POSITIVE_J: (f64, f64) = (10.0, 16.0);
const SATURATION_MAX_PERCENT: f64 = 1.0;
const READY_SKEW_MAX_MS: f64 = 50.0;
const TORQUE_RATE_MAX_NM_S: f64 = 2000.0;
/// Relative tolerance of a limit: for differences of floating-point numbers only. Zero stays zero.
const ROUNDING: f64 = 1e-9;
/// With a kill one stride before or after it is enough.
const STRIDES_COUNTED_MIN: f64 = 1.0;
/// Loss detected within 200 ms and all drives damping within 50 ms more.
const ALL_SAFE_MAX_MS: f64 = 250.0;

/// One limit: the expectation and the observation.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct LimitCheck {
    /// The limited quantity, with its unit.
    pub name: String,
    /// The expectation, as text.
    pub expected: String,
    /// The observation; `null` if it never happened.
    pub seen: Option<f64>,
    /// Whether the limit held.
    pub held: bool,
    /// Whether the host disturbed the run where this was measured: a limit that did not hold is not judged
    /// then.
    pub disturbed: bool,
}

/// The verdict: a broken limit counts if the host did not disturb it.
pub(super) fn verdict(limits: &[LimitCheck]) -> Verdict {
    let mut broken = limits.iter().filter(|limit| !limit.held).peekable();
    if broken.peek().is_none() {
        Verdict::Passed
    } else if broken.all(|limit| limit.disturbed) {
        Verdict::Inconclusive
    } else {
        Verdict::Failed
    }
}

/// Checks all limits that apply: those on strides with `judged`, the rest with the figures of the whole run.
pub(super) fn check(
    whole: &Metrics,
    judged: &Metrics,
    disturbance: &Disturbance,
    run: &RunDescription,
) -> Vec<LimitCheck> {
    let disturbed = |disturbed: bool, checks: Vec<LimitCheck>| {
        checks.into_iter().map(move |check| LimitCheck { disturbed, ..check })
    };
    let start = vec![at_most("spread of READY, ms", READY_SKEW_MAX_MS, whole.barrier.ready_skew_ms)];
    let mut checks =
        vec![at_most("torque before release, Nm", 0.0, Some(whole.barrier.torque_before_release_nm))];
    checks.extend(disturbed(disturbance.at_start, start));
    checks.extend(disturbed(disturbance.too_few, of_strides(judged)));
    checks.push(at_most("torque rate, Nm/s", TORQUE_RATE_MAX_NM_S, Some(whole.torque_rate_max_nm_s)));
    if run.kill.is_some() {
        checks.extend(disturbed(disturbance.at_fault, of_fault(whole)));
    }
    checks
}

fn of_strides(metrics: &Metrics) -> Vec<LimitCheck> {
    let strides = (metrics.strides_counted * 100.0).round() / 100.0;
    let mut checks = vec![
        at_least("strides that count", STRIDES_COUNTED_MIN, Some(strides)),
        at_most("phase RMS, %", PHASE_RMS_MAX_PERCENT, Some(metrics.phase_rms_percent)),
    ];
    for joint in Joint::ALL {
        let i = joint.index();
        checks.push(at_most(&format!("{joint} RMS, deg"), RMS_MAX_DEG[i], Some(metrics.rms_deg[i])));
    }
    let (low, high) = WORK_POSITIVE_J;
    let work_j = metrics.work_positive_j_per_stride.iter().sum();
    checks.push(check_of("work into the leg, J/stride", format!("{low}..{high}"), Some(work_j), |seen| {
        (low..=high).contains(&seen)
    }));
    for joint in Joint::ALL {
        let (name, expected) = (format!("{joint} at torque limit, %"), format!("< {SATURATION_MAX_PERCENT}"));
        let seen = metrics.saturation_percent[joint.index()];
        checks.push(check_of(&name, expected, Some(seen), |seen| seen < SATURATION_MAX_PERCENT));
    }
    checks
}

fn of_fault(metrics: &Metrics) -> Vec<LimitCheck> {
    let fault = metrics.fault.as_ref();
    vec![
        at_most("loss to all others SAFE, ms", ALL_SAFE_MAX_MS, fault.and_then(|f| f.all_safe_after_ms)),
        at_least("assistance came back after, s", 0.0, fault.and_then(|f| f.resumed_after_s)),
    ]
}

fn at_most(name: &str, limit: f64, seen: Option<f64>) -> LimitCheck {
    let expected = if limit == 0.0 { "exactly 0".to_owned() } else { format!("<= {limit}") };
    check_of(name, expected, seen, |seen| seen <= limit * (1.0 + ROUNDING))
}

fn at_least(name: &str, limit: f64, seen: Option<f64>) -> LimitCheck {
    check_of(name, format!(">= {limit}"), seen, |seen| seen >= limit)
}

fn check_of(name: &str, expected: String, seen: Option<f64>, holds: impl Fn(f64) -> bool) -> LimitCheck {
    LimitCheck { name: name.to_owned(), expected, seen, held: seen.is_some_and(holds), disturbed: false }
}
