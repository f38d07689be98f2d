//! A recorded walking trial from a CSV file: filtered angles as splines, heel strikes, vertical load.

use std::io::Read as _;
use std::path::Path;

use thiserror::Error;

use super::filter::LowPass;
use super::motion::{self, MotionError};
use super::spline::{Spline, SplinePoint};
use super::table::{BYTES_MAX, Table, TableError, TableRow};
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
/// Longest step of time, s. The filter needs many more samples than its cut-off has periods.
const STEP_LONGEST_S: f64 = 0.025;
/// Shortest step of time, s.
const STEP_SHORTEST_S: f64 = 0.000_9;
/// Maximum gap that is bridged, s: the shipped recording's capture gaps of up to 140 ms are interpolated in
/// the file.
const GAP_BRIDGED_S: f64 = 0.150;

/// The reason why a trial could not be used. Each text names the place and the remedy.
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
    /// A gap without a time.
    #[error("line {line}: `time_s` has no number; give every line its time, in gaps too")]
    TimeMissing {
        /// Line in the file, from 1.
        line: u64,
    },
    /// Time does not rise.
    #[error(
        "line {line}: `time_s` goes from {from_s} to {to_s} and has to rise; remove the line, or sort the file by time"
    )]
    TimeNotRising {
        /// Line in the file, from 1.
        line: u64,
        /// Time of the line before, s.
        from_s: f64,
        /// Time of this line, s.
        to_s: f64,
    },
    /// The steps are equal, but not those of a recording in seconds.
    #[error("`time_s` steps by {step_s}, and 0.001 to 0.025 s can be used; {hint}")]
    TimeStep {
        /// The step of the whole trial.
        step_s: f64,
        /// The possible cause.
        hint: &'static str,
    },
    /// Motion that is impossible for a joint.
    #[error(transparent)]
    Motion(#[from] MotionError),
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
        "only {found} heel strikes (`stance_r` going from 0 to 1) in the longest part without a gap; at least {HEEL_STRIKES_MIN} are needed"
    )]
    TooFewHeelStrikes {
        /// Heel strikes found.
        found: usize,
    },
    /// The time between two heel strikes is no stride.
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
    notes: Vec<String>,
}

impl Trial {
    /// Reads a trial file.
    ///
    /// # Errors
    /// [`TrialError`]: unreadable file, garbled or implausible line, uneven time, too few strides.
    pub fn read(path: &Path) -> Result<Self, TrialError> {
        let unreadable = |reason: String| TableError::Unreadable { path: path.display().to_string(), reason };
        let file = std::fs::File::open(path).map_err(|e| unreadable(e.to_string()))?;
        let mut bytes = Vec::new();
        file.take(BYTES_MAX + 1).read_to_end(&mut bytes).map_err(|e| unreadable(e.to_string()))?;
        if bytes.len() as u64 > BYTES_MAX {
            return Err(TableError::TooLarge { path: path.display().to_string() }.into());
        }
        let text = String::from_utf8(bytes).map_err(|e| {
            let line =
                1 + e.as_bytes()[..e.utf8_error().valid_up_to()].iter().filter(|b| **b == b'\n').count();
            unreadable(format!("line {line} is not UTF-8 text"))
        })?;
        Self::parse(&text)
    }

    /// Reads a trial from the text of a CSV file with the columns `time_s`, `hip_r_deg`, `knee_r_deg`,
    /// `ankle_r_deg`, `grf_v_r` (body weights) and `stance_r` (0 or 1). A column `gap` is 1 where the
    /// recording has a gap. A gap that is longer than 150 ms, or without numbers, splits the recording, and
    /// the part with the most strides is used. Other columns are ignored.
    ///
    /// # Errors
    /// [`TrialError`] as for [`Trial::read`].
    pub fn parse(text: &str) -> Result<Self, TrialError> {
        let table = Table::parse(text, &COLUMNS)?;
        let step_s = check_time(table.rows())?;
        let Part { rows, heel_strikes_s, notes } = Part::longest(table.rows(), step_s)?;
        check_ranges(rows)?;
        motion::check(rows, step_s, &heel_strikes_s)?;
        let column = |place: usize| -> Vec<f64> { rows.iter().map(|row| row.values[place]).collect() };
        let time = column(0);
        let too_short = || TrialError::TooShort { rows: time.len(), needed: ROWS_MIN };
        if time.len() < ROWS_MIN {
            return Err(too_short());
        }
        let filter = LowPass::butterworth(CUTOFF_HZ, 1.0 / step_s).ok_or_else(too_short)?;
        let spline = |place: usize| {
            let radians: Vec<f64> = column(place).iter().map(|d| d.to_radians()).collect();
            Spline::through(time.clone(), filter.zero_phase(&radians)).ok_or_else(too_short)
        };
        Ok(Self {
            start_s: time[0],
            step_s,
            hip_raw_deg: column(1),
            load_bw: column(4),
            angles_rad: [spline(1)?, spline(2)?, spline(3)?],
            heel_strikes_s,
            notes,
        })
    }

    /// The parts that were omitted or bridged, a sentence each.
    #[must_use]
    pub fn notes(&self) -> &[String] {
        &self.notes
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
fn check_time(rows: &[TableRow]) -> Result<f64, TrialError> {
    if rows.len() < ROWS_MIN {
        return Err(TrialError::TooShort { rows: rows.len(), needed: ROWS_MIN });
    }
    let time_s = |row: &TableRow| row.values[0];
    if let Some(row) = rows.iter().find(|row| !time_s(row).is_finite()) {
        return Err(TrialError::TimeMissing { line: row.line });
    }
    let mut steps: Vec<f64> = rows.windows(2).map(|pair| time_s(&pair[1]) - time_s(&pair[0])).collect();
    steps.sort_by(f64::total_cmp);
    // The median: a few wrong lines do not change it.
    let expected_s = steps[steps.len() / 2];
    for pair in rows.windows(2) {
        let (from_s, to_s, line) = (time_s(&pair[0]), time_s(&pair[1]), pair[1].line);
        let step_s = to_s - from_s;
        if step_s <= 0.0 {
            return Err(TrialError::TimeNotRising { line, from_s, to_s });
        }
        if (step_s - expected_s).abs() > 0.1 * expected_s {
            return Err(TrialError::UnevenTime { line, step_s, expected_s });
        }
    }
    let mean_s = (time_s(&rows[rows.len() - 1]) - time_s(&rows[0])) / (rows.len() - 1) as f64;
    if (STEP_SHORTEST_S..=STEP_LONGEST_S).contains(&mean_s) {
        return Ok(mean_s);
    }
    let hint = match mean_s {
        step if (0.9..=25.0).contains(&step) => "is it in milliseconds, or a number of frames? give seconds",
        step if (900.0..=25_000.0).contains(&step) => "is it in microseconds? give seconds",
        step if step < STEP_SHORTEST_S => "resample to 1 to 25 ms",
        _ => "record, or resample, at 40 Hz or more",
    };
    Err(TrialError::TimeStep { step_s: (mean_s * 1e6).round() / 1e6, hint })
}

fn check_ranges(rows: &[TableRow]) -> Result<(), TrialError> {
    let limits = [
        (1, -ANGLE_LARGEST_DEG, ANGLE_LARGEST_DEG),
        (2, -ANGLE_LARGEST_DEG, ANGLE_LARGEST_DEG),
        (3, -ANGLE_LARGEST_DEG, ANGLE_LARGEST_DEG),
        (4, -LOAD_LARGEST_BW, LOAD_LARGEST_BW),
        (5, 0.0, 1.0),
    ];
    for row in rows {
        for (place, low, high) in limits {
            let value = row.values[place];
            if !(low..=high).contains(&value) {
                let (line, column) = (row.line, COLUMNS[place]);
                return Err(TrialError::Implausible { line, column, value, low, high });
            }
        }
    }
    Ok(())
}

/// A part of the recording without a long gap.
struct Part<'a> {
    rows: &'a [TableRow],
    heel_strikes_s: Vec<f64>,
    notes: Vec<String>,
}

impl<'a> Part<'a> {
    /// The part with the most strides, the first of them in a tie.
    fn longest(rows: &'a [TableRow], step_s: f64) -> Result<Self, TrialError> {
        let (breaks, bridged) = gaps(rows, step_s);
        let mut from = 0;
        let mut best: Option<(&[TableRow], Vec<f64>)> = None;
        for (start, end) in breaks.iter().copied().chain([(rows.len(), rows.len())]) {
            let part = &rows[from..start];
            let strikes = heel_strikes(part)?;
            if best.as_ref().is_none_or(|(_, most)| strikes.len() > most.len()) {
                best = Some((part, strikes));
            }
            from = end;
        }
        let (part, heel_strikes_s) = best.unwrap_or_default();
        if heel_strikes_s.len() < HEEL_STRIKES_MIN {
            return Err(TrialError::TooFewHeelStrikes { found: heel_strikes_s.len() });
        }
        let notes = left_out(rows, &breaks, &heel_strikes_s).into_iter().chain(bridged).collect();
        Ok(Self { rows: part, heel_strikes_s, notes })
    }
}

/// The gaps that split the recording, as ranges of row indices, and a sentence on those that are bridged.
fn gaps(rows: &[TableRow], step_s: f64) -> (Vec<(usize, usize)>, Option<String>) {
    let (mut breaks, mut bridged, mut longest_s) = (Vec::new(), 0, 0.0_f64);
    let mut from = 0;
    while let Some(start) = rows[from..].iter().position(|row| row.is_gap).map(|place| from + place) {
        let end = rows[start..].iter().position(|row| !row.is_gap).map_or(rows.len(), |place| start + place);
        let lasts_s = (end - start) as f64 * step_s;
        let has_numbers = rows[start..end].iter().all(|row| row.values.iter().all(|value| value.is_finite()));
        if lasts_s <= GAP_BRIDGED_S && has_numbers {
            bridged += 1;
            longest_s = longest_s.max(lasts_s);
        } else {
            breaks.push((start, end));
        }
        from = end;
    }
    let words = || {
        format!(
            "{bridged} marked gaps of up to {:.0} ms are interpolated in the file; their strides are used",
            1000.0 * longest_s
        )
    };
    (breaks, (bridged > 0).then(words))
}

/// A sentence on the unused parts of a recording with gaps.
fn left_out(rows: &[TableRow], breaks: &[(usize, usize)], used_s: &[f64]) -> Option<String> {
    let (first_s, last_s) = (used_s.first()?, used_s.last()?);
    let times_s = |(start, end): &(usize, usize)| {
        format!("{:.2} to {:.2} s", rows[*start].values[0], rows[end - 1].values[0])
    };
    let each: Vec<String> = breaks.iter().take(LISTED_MAX).map(times_s).collect();
    let more = breaks.len().saturating_sub(LISTED_MAX);
    let more = if more > 0 { format!(" and {more} more") } else { String::new() };
    (!breaks.is_empty()).then(|| {
        format!(
            "gaps at {}{more}; used is the longest part without them, {} strides from {first_s:.2} to {last_s:.2} s",
            each.join(", "),
            used_s.len() - 1
        )
    })
}

/// Gaps that are listed one by one.
const LISTED_MAX: usize = 5;

/// The times of the rows at which `stance_r` goes from 0 to 1: at most one sample after the real event.
fn heel_strikes(rows: &[TableRow]) -> Result<Vec<f64>, TrialError> {
    let mut strikes: Vec<f64> = Vec::new();
    for pair in rows.windows(2) {
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
    Ok(strikes)
}
