//! Figures from a record: tracking, phase, work, torque, and the course of a fault.
//!
//! Strides 1 to 6 are for the estimator to settle; figures count from stride 7 on. In a run with a fault they
//! pause from the fault until two whole strides after assistance has returned. Strides in which the host of a
//! real-time run stalled are in [`Metrics::of`] and not in [`Metrics::without_stalls`].

use std::collections::BTreeSet;

use serde::{Serialize, Serializer};

use crate::gait::curves;
use crate::joint::{Joint, PerJoint};
use crate::message::{DriveState, GaitMode};
use crate::part::Part;
use crate::phase::wrapped;
use crate::record::{Outage, Record, Row, Stall};

/// First stride that counts, from 0.
pub const FIRST_STRIDE_COUNTED: f64 = 6.0;
/// Strides after the return of assistance that do not count.
const STRIDES_AFTER_RETURN: f64 = 2.0;
/// Strides after the one in which the host stood still that do not count.
const STRIDES_AFTER_STALL: f64 = 1.0;

/// The course of a killed node's absence.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct FaultFigures {
    /// The node and its absence.
    #[serde(flatten)]
    pub outage: Outage,
    /// Time from its death until all other drives damped, ms; `None` if not all ever did.
    pub all_safe_after_ms: Option<f64>,
    /// Time from its return until central allowed assistance again, seconds; `None` if it never did.
    pub resumed_after_s: Option<f64>,
    /// Greatest deviation from the intended angle from the death until the return of assistance, degrees.
    #[serde(serialize_with = "by_joint")]
    pub deviation_max_deg: PerJoint<f64>,
}

/// The course of the barrier.
#[derive(Debug, Clone, Copy, PartialEq, Serialize)]
pub struct Barrier {
    /// Time the first node waited until all drives were ready, seconds; `None` if they never were.
    pub held_s: Option<f64>,
    /// Time between the first and the last drive to be ready, ms; `None` if one never was.
    pub ready_skew_ms: Option<f64>,
    /// Maximum torque, commanded or applied, before walking was released, Nm.
    pub torque_before_release_nm: f64,
}

/// Figures of a run.
#[derive(Debug, Clone, PartialEq, Serialize)]
pub struct Metrics {
    /// Strides that counted.
    pub strides_counted: f64,
    /// RMS of the angle against the reference at the estimated phase, degrees.
    #[serde(serialize_with = "by_joint")]
    pub rms_deg: PerJoint<f64>,
    /// RMS of the angle against the person's intention, degrees.
    #[serde(serialize_with = "by_joint")]
    pub rms_intended_deg: PerJoint<f64>,
    /// RMS of the phase error, per cent of a stride.
    pub phase_rms_percent: f64,
    /// Greatest phase error, per cent of a stride.
    pub phase_max_percent: f64,
    /// Work the devices put into the leg, J per stride.
    #[serde(serialize_with = "by_joint")]
    pub work_positive_j_per_stride: PerJoint<f64>,
    /// Work the devices took out of the leg (negative), J per stride.
    #[serde(serialize_with = "by_joint")]
    pub work_negative_j_per_stride: PerJoint<f64>,
    /// Maximum torque applied, Nm.
    #[serde(serialize_with = "by_joint")]
    pub torque_peak_nm: PerJoint<f64>,
    /// Share of the time in which the torque law was at its limit, per cent.
    #[serde(serialize_with = "by_joint")]
    pub saturation_percent: PerJoint<f64>,
    /// Fastest change of the commanded torque in the whole run, Nm/s.
    pub torque_rate_max_nm_s: f64,
    /// The barrier.
    pub barrier: Barrier,
    /// Strides until assistance was first allowed; `None` if it never was.
    pub assisted_from_stride: Option<f64>,
    /// The killed node, if one was.
    pub fault: Option<FaultFigures>,
}

impl Metrics {
    /// Computes all figures.
    #[must_use]
    pub fn of(record: &Record) -> Self {
        Self::leaving_out(record, &[])
    }

    /// Computes all figures without the strides around stalls of the host.
    #[must_use]
    pub fn without_stalls(record: &Record) -> Self {
        Self::leaving_out(record, &record.stalls)
    }

    fn leaving_out(record: &Record, stalls: &[Stall]) -> Self {
        let fault = record.outage.map(|outage| fault_figures(record, outage));
        let counting = Counting::with(record, fault.as_ref(), stalls);
        let counted: Vec<&Row> = record.rows.iter().filter(|row| counting.counts(row)).collect();
        let strides_counted = strides_in(&counted);
        let per_stride = |sum: PerJoint<f64>| sum.map(|x| x / strides_counted.max(f64::MIN_POSITIVE));
        let power = |row: &Row, i: usize| row.joints[i].applied_nm * row.joints[i].velocity_rad_s;
        let sum = |f: &dyn Fn(&Row, usize) -> f64| -> PerJoint<f64> {
            std::array::from_fn(|i| counted.iter().map(|row| f(row, i)).sum())
        };
        let rms = |f: &dyn Fn(&Row, usize) -> f64| {
            sum(&|row, i| f(row, i).to_degrees().powi(2)).map(|x| mean(x, counted.len()).sqrt())
        };
        let phase_error = |row: &Row| 100.0 * wrapped(row.phase_estimated - row.strides_true);
        Self {
            strides_counted,
            rms_deg: rms(&|row, i| row.joints[i].angle_rad - reference_rad(i, row.phase_estimated)),
            rms_intended_deg: rms(&|row, i| row.joints[i].angle_rad - row.joints[i].intended_rad),
            phase_rms_percent: mean(counted.iter().map(|r| phase_error(r).powi(2)).sum(), counted.len())
                .sqrt(),
            phase_max_percent: counted.iter().map(|r| phase_error(r).abs()).fold(0.0, f64::max),
            work_positive_j_per_stride: per_stride(sum(&|r, i| power(r, i).max(0.0) * ROW_S)),
            work_negative_j_per_stride: per_stride(sum(&|r, i| power(r, i).min(0.0) * ROW_S)),
            torque_peak_nm: std::array::from_fn(|i| {
                counted.iter().map(|r| r.joints[i].applied_nm.abs()).fold(0.0, f64::max)
            }),
            saturation_percent: sum(&|r, i| f64::from(u8::from(r.joints[i].saturated)))
                .map(|x| 100.0 * mean(x, counted.len())),
            torque_rate_max_nm_s: torque_rate_max(record),
            barrier: barrier(record),
            assisted_from_stride: record
                .rows
                .iter()
                .find(|r| r.mode == Some(GaitMode::Walk))
                .map(|r| r.strides_true),
            fault,
        }
    }
}

/// Duration of a row, seconds.
const ROW_S: f64 = 1e-3;

fn reference_rad(joint: usize, phase: f64) -> f64 {
    curves::angle_rad(Joint::ALL[joint], phase).value
}

/// The rows that count; see the top of this file.
#[derive(Debug, Clone, PartialEq)]
pub struct Counting {
    /// Death of a node, or an omitted stall of the host (seconds of the run), and the stride from which
    /// figures count again.
    pauses: Vec<(f64, f64)>,
}

impl Counting {
    /// The rule for this record.
    #[must_use]
    pub fn of(record: &Record) -> Self {
        Self::with(record, record.outage.map(|outage| fault_figures(record, outage)).as_ref(), &[])
    }

    /// Whether the figures of this row count.
    #[must_use]
    pub fn counts(&self, row: &Row) -> bool {
        let paused =
            self.pauses.iter().any(|(from_s, stride)| row.t_s >= *from_s && row.strides_true < *stride);
        row.walking && row.strides_true >= FIRST_STRIDE_COUNTED && !paused
    }

    /// The strides that do not count because of a stall of the host, the first stride being 1.
    #[must_use]
    pub fn disturbed(record: &Record) -> Vec<u32> {
        let fault = record.outage.map(|outage| fault_figures(record, outage));
        let [all, undisturbed] =
            [&[][..], &record.stalls].map(|stalls| Self::with(record, fault.as_ref(), stalls));
        let is_disturbed = |row: &&Row| all.counts(row) && !undisturbed.counts(row);
        let strides = record.rows.iter().filter(is_disturbed).map(|row| row.strides_true as u32 + 1);
        strides.filter(|stride| *stride <= record.strides).collect::<BTreeSet<u32>>().into_iter().collect()
    }

    fn with(record: &Record, fault: Option<&FaultFigures>, stalls: &[Stall]) -> Self {
        let whole_stride_after =
            |s: f64| record.rows.iter().find(|r| r.t_s >= s).map_or(f64::INFINITY, |r| r.strides_true.ceil());
        let fault = fault.map(|fault| {
            let resumed_s =
                fault.outage.to_s.zip(fault.resumed_after_s).map(|(to_s, after_s)| to_s + after_s);
            let from_stride = resumed_s.map_or(f64::INFINITY, whole_stride_after) + STRIDES_AFTER_RETURN;
            (fault.outage.from_s, from_stride)
        });
        let stall = |stall: &Stall| (stall.from_s, whole_stride_after(stall.to_s) + STRIDES_AFTER_STALL);
        Self { pauses: fault.into_iter().chain(stalls.iter().map(stall)).collect() }
    }
}

/// Strides covered by rows that may have gaps between them.
fn strides_in(rows: &[&Row]) -> f64 {
    rows.windows(2)
        .map(|pair| pair[1].strides_true - pair[0].strides_true)
        .filter(|advance| *advance < 0.01)
        .sum()
}

fn mean(sum: f64, count: usize) -> f64 {
    if count == 0 { f64::NAN } else { sum / count as f64 }
}

fn torque_rate_max(record: &Record) -> f64 {
    let mut fastest = 0.0_f64;
    for pair in record.rows.windows(2) {
        for i in 0..3 {
            if let (Some(a), Some(b)) = (pair[0].joints[i].commanded_nm, pair[1].joints[i].commanded_nm) {
                fastest = fastest.max((b - a).abs() / ROW_S);
            }
        }
    }
    fastest
}

fn barrier(record: &Record) -> Barrier {
    let released_s = record.released_s.unwrap_or(f64::INFINITY);
    let before = record.rows.iter().take_while(|row| row.t_s <= released_s).flat_map(|row| row.joints);
    let torques = before.map(|joint| joint.applied_nm.abs().max(joint.commanded_nm.map_or(0.0, f64::abs)));
    let torque_before_release_nm = torques.fold(0.0, f64::max);
    let [Some(hip), Some(knee), Some(ankle)] = record.ready_s else {
        return Barrier { held_s: None, ready_skew_ms: None, torque_before_release_nm };
    };
    let (first, last) = (hip.min(knee).min(ankle), hip.max(knee).max(ankle));
    Barrier {
        held_s: Some(last - record.first_start_s),
        ready_skew_ms: Some(1000.0 * (last - first)),
        torque_before_release_nm,
    }
}

/// Writes a value of each joint by the joint's name.
pub(crate) fn by_joint<S: Serializer>(values: &PerJoint<f64>, to: S) -> Result<S::Ok, S::Error> {
    to.collect_map(Joint::ALL.map(Joint::name).into_iter().zip(values))
}

fn fault_figures(record: &Record, outage: Outage) -> FaultFigures {
    let after: Vec<&Row> = record.rows.iter().filter(|r| r.t_s >= outage.from_s).collect();
    let damped = |row: &Row| {
        Joint::ALL.into_iter().all(|joint| {
            Part::Joint(joint) == outage.part || row.joints[joint.index()].state == Some(DriveState::Safe)
        })
    };
    let safe_s = after.iter().find(|r| damped(r)).map(|r| r.t_s);
    let resumed_s = outage.to_s.and_then(|to_s| {
        after.iter().find(|r| r.t_s >= to_s && r.mode == Some(GaitMode::Walk)).map(|r| r.t_s)
    });
    let away: Vec<&&Row> = after.iter().take_while(|r| resumed_s.is_none_or(|s| r.t_s < s)).collect();
    FaultFigures {
        outage,
        all_safe_after_ms: safe_s.map(|s| 1000.0 * (s - outage.from_s)),
        resumed_after_s: outage.to_s.zip(resumed_s).map(|(to_s, resumed_s)| resumed_s - to_s),
        deviation_max_deg: std::array::from_fn(|i| {
            away.iter()
                .map(|r| (r.joints[i].angle_rad - r.joints[i].intended_rad).abs().to_degrees())
                .fold(0.0, f64::max)
        }),
    }
}
