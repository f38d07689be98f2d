//! Checks whether the columns of a recording move as a walking person's joints do.
//!
//! A value in its range may still be wrong: a lost marker is written as 0 or held, an angle is in radians,
//! has the other sign, or is in another joint's column.

use thiserror::Error;

use super::table::TableRow;
use crate::joint::Joint;

/// Maximum speed of a joint, deg/s. Sprinters reach 1100 at the knee.
const RATE_MAX_DEG_S: f64 = 1500.0;
/// This many consecutive samples with the same three angles are no measurement.
const REPEATS_ALL_MIN: usize = 5;
/// A single joint may stand still for a few samples; it does not for this long, exactly, while its leg walks,
/// s.
const REPEATS_ONE_MIN_S: f64 = 0.2;
/// Smallest span of a walking knee, degrees.
const KNEE_SPAN_MIN_DEG: f64 = 10.0;
/// Maximum angle of a joint in radians.
const RADIANS_MAX: f64 = 3.2;
/// Loads of a standing foot, body weights.
const LOAD_BW: (f64, f64) = (0.2, 3.0);

/// Motion that is impossible for a walking person's joint. Each text names the place and the remedy.
#[derive(Debug, Clone, PartialEq, Error)]
pub enum MotionError {
    /// Too fast.
    #[error(
        "line {line}: the {joint} turns by {rate_deg_s:.0} deg/s, and no joint is faster than {RATE_MAX_DEG_S}; repair the line, or \
         mark it with `gap` 1 if the marker was lost"
    )]
    TooFast {
        /// Line in the file, from 1.
        line: u64,
        /// The joint.
        joint: Joint,
        /// Its speed.
        rate_deg_s: f64,
    },
    /// A lost marker.
    #[error(
        "line {line}: {joints} exactly the same for {samples} samples from here on, as where a marker was lost; repair the lines, or \
         mark them with `gap` 1"
    )]
    Repeats {
        /// Line of the first of them, from 1.
        line: u64,
        /// Subject and verb.
        joints: String,
        /// Number of samples.
        samples: usize,
    },
    /// The knee hardly moves.
    #[error("`knee_r_deg` spans only {span_deg:.2} degrees, and a walking knee bends by 40 and more; {hint}")]
    KneeSpan {
        /// Its span.
        span_deg: f64,
        /// The possible cause.
        hint: &'static str,
    },
    /// The knee bends the other way.
    #[error(
        "`knee_r_deg` is negative in {percent:.0} % of the samples, and no knee bends forward; is flexion negative in this file, or are columns swapped? change \
         the sign of the column"
    )]
    KneeNegative {
        /// Share of the samples.
        percent: f64,
    },
    /// A joint moves against its convention.
    #[error(
        "`{column}` is {early_deg:.1} degrees at {early} and {late_deg:.1} degrees at {late}, on average, and a walking leg has it the \
         other way round; check its sign ({sign}), whether columns are swapped, and whether `stance_r` is 1 while the foot is on the ground"
    )]
    Convention {
        /// The column.
        column: &'static str,
        /// The positive direction.
        sign: &'static str,
        /// First place in the stride.
        early: &'static str,
        /// Mean angle there.
        early_deg: f64,
        /// Second place in the stride.
        late: &'static str,
        /// Mean angle there.
        late_deg: f64,
    },
    /// The load of a standing foot is not plausible.
    #[error(
        "`grf_v_r` is {mean_bw:.3} on average while `stance_r` is 1, and a foot bears {} to {} body weights; check its unit and sign",
        LOAD_BW.0,
        LOAD_BW.1
    )]
    Load {
        /// Mean load.
        mean_bw: f64,
    },
}

/// Checks rows with time, hip, knee, ankle, load and stance; stride checks use the part between first and
/// last heel strike.
pub(super) fn check(rows: &[TableRow], step_s: f64, heel_strikes_s: &[f64]) -> Result<(), MotionError> {
    // The unit and the sign first: they affect all other checks.
    check_knee(rows)?;
    let wrong =
        [first_too_fast(rows, step_s), repeats_of_all(rows), repeats_of_one(rows, step_s, heel_strikes_s)];
    // A lost marker shows as both: the place where it begins is the one to repair.
    if let Some((_, error)) = wrong.into_iter().flatten().min_by_key(|(line, _)| *line) {
        return Err(error);
    }
    check_conventions(rows, heel_strikes_s)?;
    let (sum, count) = rows
        .iter()
        .filter(|row| row.values[5] >= 0.5)
        .fold((0.0, 0.0), |(sum, count), row| (sum + row.values[4], count + 1.0));
    let mean_bw = sum / f64::max(count, 1.0);
    if (LOAD_BW.0..=LOAD_BW.1).contains(&mean_bw) { Ok(()) } else { Err(MotionError::Load { mean_bw }) }
}

fn angle_deg(row: &TableRow, joint: Joint) -> f64 {
    row.values[1 + joint.index()]
}

fn check_knee(rows: &[TableRow]) -> Result<(), MotionError> {
    let range = |joint| {
        rows.iter()
            .map(|row| angle_deg(row, joint))
            .fold((f64::INFINITY, f64::NEG_INFINITY), |(low, high), x| (f64::min(low, x), f64::max(high, x)))
    };
    let (low, high) = range(Joint::Knee);
    let span_deg = high - low;
    if span_deg < KNEE_SPAN_MIN_DEG {
        let small = |joint| {
            let (low, high) = range(joint);
            low >= -RADIANS_MAX && high <= RADIANS_MAX
        };
        let hint = if Joint::ALL.into_iter().all(small) {
            "is the file in radians? multiply the angles by 57.2958"
        } else {
            "check its unit, and whether columns are swapped"
        };
        return Err(MotionError::KneeSpan { span_deg, hint });
    }
    let negative = rows.iter().filter(|row| angle_deg(row, Joint::Knee) < 0.0).count();
    let percent = 100.0 * negative as f64 / rows.len() as f64;
    if percent > 50.0 { Err(MotionError::KneeNegative { percent }) } else { Ok(()) }
}

/// The first motion that is too fast, with its line.
fn first_too_fast(rows: &[TableRow], step_s: f64) -> Option<(u64, MotionError)> {
    rows.windows(2).find_map(|pair| {
        let line = pair[1].line;
        let rate = |joint| (angle_deg(&pair[1], joint) - angle_deg(&pair[0], joint)).abs() / step_s;
        let joint = Joint::ALL.into_iter().find(|joint| rate(*joint) > RATE_MAX_DEG_S)?;
        Some((line, MotionError::TooFast { line, joint, rate_deg_s: rate(joint) }))
    })
}

/// The first samples in which all joints stand still, with their line.
fn repeats_of_all(rows: &[TableRow]) -> Option<(u64, MotionError)> {
    let all = |row: &TableRow| Joint::ALL.map(|joint| angle_deg(row, joint).to_bits());
    let (line, samples) = repeats(rows, all, REPEATS_ALL_MIN)?;
    Some((line, MotionError::Repeats { line, joints: "all joints are".to_owned(), samples }))
}

/// The first samples in which one joint of the walking leg stands still, with their line.
fn repeats_of_one(rows: &[TableRow], step_s: f64, heel_strikes_s: &[f64]) -> Option<(u64, MotionError)> {
    let (first_s, last_s) = (heel_strikes_s.first()?, heel_strikes_s.last()?);
    let from = rows.partition_point(|row| row.values[0] < *first_s);
    let strides = &rows[from..rows.partition_point(|row| row.values[0] <= *last_s)];
    let least = (REPEATS_ONE_MIN_S / step_s).ceil() as usize;
    let each = Joint::ALL.into_iter().filter_map(|joint| {
        let (line, samples) = repeats(strides, |row| angle_deg(row, joint).to_bits(), least)?;
        Some((line, MotionError::Repeats { line, joints: format!("the {joint} is"), samples }))
    });
    each.min_by_key(|(line, _)| *line)
}

/// The first run of at least this many rows with the same value: its line and length.
fn repeats<T: PartialEq>(
    rows: &[TableRow],
    value: impl Fn(&TableRow) -> T,
    least: usize,
) -> Option<(u64, usize)> {
    rows.chunk_by(|a, b| value(a) == value(b))
        .find(|run| run.len() >= least)
        .map(|run| (run[0].line, run.len()))
}

/// For each joint, two places of the stride with clearly different angles, in the same order in every gait.
fn check_conventions(rows: &[TableRow], heel_strikes_s: &[f64]) -> Result<(), MotionError> {
    let mean_deg = |joint: Joint, phase: f64| {
        let at = heel_strikes_s.windows(2).filter_map(|stride| {
            let time_s = stride[0] + phase * (stride[1] - stride[0]);
            rows.get(rows.partition_point(|row| row.values[0] < time_s))
        });
        let (sum, count) =
            at.fold((0.0, 0.0), |(sum, count), row| (sum + angle_deg(row, joint), count + 1.0));
        sum / f64::max(count, 1.0)
    };
    let places = [
        (
            Joint::Hip,
            "hip_r_deg",
            "flexion is positive",
            (0.0, "heel strike"),
            (0.5, "half of the stride"),
            1.0,
        ),
        (Joint::Knee, "knee_r_deg", "flexion is positive", (0.4, "40 % of the stride"), (0.72, "72 %"), -1.0),
        (
            Joint::Ankle,
            "ankle_r_deg",
            "dorsiflexion is positive",
            (0.45, "45 % of the stride"),
            (0.66, "66 %"),
            1.0,
        ),
    ];
    for (joint, column, sign, (early_at, early), (late_at, late), falls) in places {
        let (early_deg, late_deg) = (mean_deg(joint, early_at), mean_deg(joint, late_at));
        if (early_deg - late_deg) * falls < 0.0 {
            return Err(MotionError::Convention { column, sign, early, early_deg, late, late_deg });
        }
    }
    Ok(())
}
