//! A recorded walking trial from a CSV file: filtered angles as splines, heel strikes, vertical load.

use std::path::Path;

use thiserror::Error;

use super::filter::LowPass;
use super::spline::{Spline, SplinePoint};
use super::table::{Table, TableError};
use crate::joint::{Joint, PerJoint};

/// Cut-off of the zero-phase low-pass for the recorded angles, Hz.
pub const CUTOFF_HZ: f64 = 6.0;
/// Fewest heel strikes that make a usable trial.
pub const HEEL_STRIKES_MIN: usize = 5;

const COLUMNS: [&str; 6] = ["time_s", "hip_r_deg", "knee_r_deg", "ankle_r_deg", "grf_v_r", "stance_r"];
const ANGLE_LARGEST_DEG: f64 = 180.0;
const LOAD_LARGEST_BW: f64 = 10.0;
const STRIDE_SHORTEST_S: f64 = 0.4;
const STRIDE_LONGEST_S: f64 = 4.0;

/// Why a trial could not be used. Each text names the place and what to do.
#[derive(Debug, Error)]
pub enum TrialError {
    /// The file is not readable as a table.
    #[error(transparent)]
    Table(#[from] TableError),
    /// A value cannot come from a walking person.
    #[error(
        "line {line}, column `{column}`: {value} is outside {low}..{high}; check the unit, then repair the line"
    )]
    Implausible {
        /// Line in the file, from 1.
        line: u64,
        /// The column's name.
        column: &'static str,
        /// The value found.
        value: f64,
        /// Least plausible value.
        low: f64,
        /// Greatest plausible value.
        high: f64,
    },
    /// The filter needs equal steps of time.
    #[error(
        "line {line}: time steps by {step_s} s where the trial steps by {expected_s} s; resample to equal steps of 1 to 25 ms"
    )]
    UnevenTime {
        /// Line in the file, from 1.
        line: u64,
        /// The step found, s.
        step_s: f64,
        /// The step of the whole trial, s.
        expected_s: f64,
    },
    /// Too few rows for a filter and a spline.
    #[error("only {rows} rows; at least {needed} are needed (record {HEEL_STRIKES_MIN} strides or more)")]
    TooShort {
        /// Rows found.
        rows: usize,
        /// Rows needed.
        needed: usize,
    },
    /// Too few steps of column `stance_r` from 0 to 1.
    #[error(
        "only {found} heel strikes (`stance_r` going from 0 to 1); at least {HEEL_STRIKES_MIN} are needed"
    )]
    TooFewHeelStrikes {
        /// Heel strikes found.
        found: usize,
    },
    /// Two heel strikes that are no stride apart.
    #[error(
        "line {line}: heel strike {interval_s} s after the one before; repair `stance_r` there (strides last {STRIDE_SHORTEST_S}..{STRIDE_LONGEST_S} s)"
    )]
    StrideImplausible {
        /// Line of the later heel strike, from 1.
        line: u64,
        /// Time between the two, s.
        interval_s: f64,
    },
}

/// A recorded trial of the right leg, ready to be walked.
#[derive(Debug, Clone)]
pub struct Trial {
    start_s: f64,
    step_s: f64,
    hip_raw_deg: Vec<f64>,
    load_bw: Vec<f64>,
    angles_rad: PerJoint<Spline>,
    heel_strikes_s: Vec<f64>,
}

impl Trial {
    /// Reads a trial file.
    ///
    /// # Errors
    /// [`TrialError`]: unreadable file, garbled or implausible line, uneven time, too few strides.
    pub fn read(path: &Path) -> Result<Self, TrialError> {
        let unreadable = |reason: String| TableError::Unreadable { path: path.display().to_string(), reason };
        let bytes = std::fs::read(path).map_err(|e| unreadable(e.to_string()))?;
        let text = String::from_utf8(bytes).map_err(|e| {
            let line =
                1 + e.as_bytes()[..e.utf8_error().valid_up_to()].iter().filter(|b| **b == b'\n').count();
            unreadable(format!("line {line} is not UTF-8 text"))
        })?;
        Self::parse(&text)
    }

    /// Reads a trial from the text of a CSV file with the columns `time_s`, `hip_r_deg`, `knee_r_deg`,
    /// `ankle_r_deg`, `grf_v_r` (body weights) and `stance_r` (0 or 1); other columns are ignored.
    ///
    /// # Errors
    /// [`TrialError`] as for [`Trial::read`].
    pub fn parse(text: &str) -> Result<Self, TrialError> {
        let table = Table::parse(text, &COLUMNS)?;
        let step_s = check_time(&table)?;
        check_ranges(&table)?;
        let heel_strikes_s = heel_strikes(&table)?;
        let time = table.column(0);
        let too_short = || TrialError::TooShort { rows: time.len(), needed: ROWS_MIN };
        let filter = LowPass::butterworth(CUTOFF_HZ, 1.0 / step_s).ok_or_else(too_short)?;
        let spline = |place: usize| {
            let radians: Vec<f64> = table.column(place).iter().map(|d| d.to_radians()).collect();
            Spline::through(time.clone(), filter.zero_phase(&radians)).ok_or_else(too_short)
        };
        Ok(Self {
            start_s: time[0],
            step_s,
            hip_raw_deg: table.column(1),
            load_bw: table.column(4),
            angles_rad: [spline(1)?, spline(2)?, spline(3)?],
            heel_strikes_s,
        })
    }

    /// Times of the heel strikes of the right leg, seconds of the file, rising; at least [`HEEL_STRIKES_MIN`].
    #[must_use]
    pub fn heel_strikes_s(&self) -> &[f64] {
        &self.heel_strikes_s
    }

    /// Filtered angle (rad), velocity (rad/s) and acceleration (rad/s2) of one joint at `time_s` of the file.
    #[must_use]
    pub fn angle_rad(&self, joint: Joint, time_s: f64) -> SplinePoint {
        self.angles_rad[joint.index()].at(time_s)
    }

    /// Unfiltered hip angle at `time_s` of the file, between samples by straight line, degrees.
    #[must_use]
    pub fn hip_raw_deg(&self, time_s: f64) -> f64 {
        self.between(&self.hip_raw_deg, time_s)
    }

    /// Vertical load under the right foot at `time_s` of the file, body weights.
    #[must_use]
    pub fn vertical_load_bw(&self, time_s: f64) -> f64 {
        self.between(&self.load_bw, time_s)
    }

    /// Strides since the first heel strike at `time_s` (whole part: stride, rest: phase), and strides per second.
    /// Clamped to the recorded strides.
    #[must_use]
    pub fn strides_at(&self, time_s: f64) -> (f64, f64) {
        let strikes = &self.heel_strikes_s;
        let i = strikes.partition_point(|s| *s <= time_s).clamp(1, strikes.len() - 1) - 1;
        let duration = strikes[i + 1] - strikes[i];
        let within = ((time_s - strikes[i]) / duration).clamp(0.0, 1.0);
        (i as f64 + within, 1.0 / duration)
    }

    fn between(&self, samples: &[f64], time_s: f64) -> f64 {
        let place = ((time_s - self.start_s) / self.step_s).clamp(0.0, (samples.len() - 1) as f64);
        let i = (place as usize).min(samples.len() - 2);
        let part = place - i as f64;
        samples[i] * (1.0 - part) + samples[i + 1] * part
    }
}

const ROWS_MIN: usize = 200;

/// Checks that time rises in equal steps and returns the step, seconds.
fn check_time(table: &Table) -> Result<f64, TrialError> {
    let rows = table.rows();
    if rows.len() < ROWS_MIN {
        return Err(TrialError::TooShort { rows: rows.len(), needed: ROWS_MIN });
    }
    let span_s = rows[rows.len() - 1].values[0] - rows[0].values[0];
    let expected_s = span_s / (rows.len() - 1) as f64;
    for pair in rows.windows(2) {
        let step_s = pair[1].values[0] - pair[0].values[0];
        let even = (step_s - expected_s).abs() <= 0.1 * expected_s;
        if !(even && (0.000_9..=0.025).contains(&step_s)) {
            return Err(TrialError::UnevenTime { line: pair[1].line, step_s, expected_s });
        }
    }
    Ok(expected_s)
}

fn check_ranges(table: &Table) -> Result<(), TrialError> {
    let limits = [
        (1, -ANGLE_LARGEST_DEG, ANGLE_LARGEST_DEG),
        (2, -ANGLE_LARGEST_DEG, ANGLE_LARGEST_DEG),
        (3, -ANGLE_LARGEST_DEG, ANGLE_LARGEST_DEG),
        (4, -LOAD_LARGEST_BW, LOAD_LARGEST_BW),
        (5, 0.0, 1.0),
    ];
    for row in table.rows() {
        for (place, low, high) in limits {
            let value = row.values[place];
            if !(low..=high).contains(&value) {
                return Err(TrialError::Implausible {
                    line: row.line,
                    column: COLUMNS[place],
                    value,
                    low,
                    high,
                });
            }
        }
    }
    Ok(())
}

/// The times of the rows at which `stance_r` goes from 0 to 1: at most one sample after the real event.
fn heel_strikes(table: &Table) -> Result<Vec<f64>, TrialError> {
    let mut strikes: Vec<f64> = Vec::new();
    for pair in table.rows().windows(2) {
        if !(pair[0].values[5] < 0.5 && pair[1].values[5] >= 0.5) {
            continue;
        }
        let time_s = pair[1].values[0];
        if let Some(before) = strikes.last() {
            let interval_s = time_s - before;
            if !(STRIDE_SHORTEST_S..=STRIDE_LONGEST_S).contains(&interval_s) {
                return Err(TrialError::StrideImplausible { line: pair[1].line, interval_s });
            }
        }
        strikes.push(time_s);
    }
    if strikes.len() < HEEL_STRIKES_MIN {
        return Err(TrialError::TooFewHeelStrikes { found: strikes.len() });
    }
    Ok(strikes)
}
