//! The record of a run: one row each millisecond, and the times of events. Metrics, plot and CSV read nothing
//! else.

use std::io;

use crate::joint::{Joint, PerJoint};
use crate::message::{DriveState, GaitMode};
use crate::part::Part;

/// One joint in one row.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct JointRow {
    /// True angle, rad.
    pub angle_rad: f64,
    /// True velocity, rad/s.
    pub velocity_rad_s: f64,
    /// Angle that the person intends, rad.
    pub intended_rad: f64,
    /// Torque the drive commands, Nm; `None` while it is silent.
    pub commanded_nm: Option<f64>,
    /// Torque that the device applies, Nm.
    pub applied_nm: f64,
    /// Whether the torque law reached the limit.
    pub saturated: bool,
    /// State of the drive; `None` while its node does not run.
    pub state: Option<DriveState>,
    /// Whether the device damps by its own watchdog.
    pub watchdog: bool,
}

/// One millisecond of a run.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Row {
    /// Time since the start of the run, seconds.
    pub t_s: f64,
    /// Strides walked: the whole part counts, the rest is the true phase.
    pub strides_true: f64,
    /// Whether the person walks.
    pub walking: bool,
    /// Phase as central estimates it, cycles 0..1; 0 while it sends nothing.
    pub phase_estimated: f64,
    /// Trust in the phase, 0..1.
    pub confidence: f64,
    /// Central's command; `None` while it sends nothing.
    pub mode: Option<GaitMode>,
    /// Joints that walk without their drive's assistance, as central reports; bit 0 hip, bit 1 knee, bit 2
    /// ankle.
    pub degraded: u8,
    /// The three joints.
    pub joints: PerJoint<JointRow>,
}

/// A node that was away for a while.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Outage {
    /// The node.
    #[serde(rename = "node")]
    pub part: Part,
    /// Time of its death, seconds of the run.
    #[serde(rename = "at_s")]
    pub from_s: f64,
    /// Time at which it ran again, seconds of the run; `None` if it never did.
    #[serde(rename = "back_at_s")]
    pub to_s: Option<f64>,
}

/// A time in which the host did not run a thread that only sleeps, through no fault of the robot; only in
/// real time.
#[derive(Debug, Clone, Copy, PartialEq, serde::Serialize)]
pub struct Stall {
    /// Start, seconds of the run.
    pub from_s: f64,
    /// End, seconds of the run.
    pub to_s: f64,
}

/// A whole run.
#[derive(Debug, Clone, PartialEq)]
pub struct Record {
    /// Strides requested.
    pub strides: u32,
    /// Start time of the first node, seconds of the run.
    pub first_start_s: f64,
    /// Time at which each drive was ready first, seconds of the run.
    pub ready_s: PerJoint<Option<f64>>,
    /// Time of the release, seconds of the run.
    pub released_s: Option<f64>,
    /// A node that was killed on purpose.
    pub outage: Option<Outage>,
    /// Stalls of the host.
    pub stalls: Vec<Stall>,
    /// Rows at 1 kHz, rising in time.
    pub rows: Vec<Row>,
}

impl Record {
    /// Writes the rows as CSV with a header line; angles in degrees, torques in Nm, empty if there is no
    /// value.
    ///
    /// # Errors
    /// Any error of the writer.
    pub fn write_csv<W: io::Write>(&self, writer: W) -> io::Result<()> {
        let mut out = csv::Writer::from_writer(writer);
        out.write_record(header())?;
        for row in &self.rows {
            out.write_record(fields(row))?;
        }
        out.flush()
    }
}

fn header() -> Vec<String> {
    let mut names: Vec<String> =
        ["time_s", "strides_true", "phase_true", "phase_estimated", "confidence", "mode"]
            .map(str::to_owned)
            .to_vec();
    for joint in Joint::ALL {
        for column in ["deg", "deg_s", "intended_deg", "commanded_nm", "applied_nm", "state"] {
            names.push(format!("{joint}_{column}"));
        }
    }
    names
}

fn fields(row: &Row) -> Vec<String> {
    let mut fields = vec![
        format!("{:.3}", row.t_s),
        format!("{:.5}", row.strides_true),
        format!("{:.5}", row.strides_true.rem_euclid(1.0)),
        format!("{:.5}", row.phase_estimated),
        format!("{:.3}", row.confidence),
        row.mode.map(|m| format!("{m:?}")).unwrap_or_default(),
    ];
    for joint in &row.joints {
        fields.push(format!("{:.4}", joint.angle_rad.to_degrees()));
        fields.push(format!("{:.3}", joint.velocity_rad_s.to_degrees()));
        fields.push(format!("{:.4}", joint.intended_rad.to_degrees()));
        fields.push(joint.commanded_nm.map(|t| format!("{t:.4}")).unwrap_or_default());
        fields.push(format!("{:.4}", joint.applied_nm));
        fields.push(joint.state.map(|s| format!("{s:?}")).unwrap_or_default());
    }
    fields
}
