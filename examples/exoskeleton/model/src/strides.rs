//! Cuts a record into strides of 101 points by the true phase.

use crate::joint::Joint;
use crate::metrics::{Counting, FIRST_STRIDE_COUNTED};
use crate::record::{JointRow, Record, Row};

/// Points of a stride: 0, 1, .. 100 % of the cycle.
pub const POINTS: usize = 101;

/// Curves of whole strides from stride 7 on: 101 values each.
#[derive(Debug, Clone)]
pub struct Strides {
    /// Strides that count for the figures.
    pub counted: Vec<Vec<f64>>,
    /// Strides in and after a fault.
    pub uncounted: Vec<Vec<f64>>,
}

impl Strides {
    /// All values, for the range of an axis.
    pub fn all(&self) -> impl Iterator<Item = f64> {
        self.counted.iter().chain(&self.uncounted).flatten().copied()
    }
}

/// Cuts `value` of a joint into strides.
#[must_use]
pub fn curves(record: &Record, joint: Joint, value: impl Fn(&JointRow) -> f64) -> Strides {
    let walking: Vec<&Row> = record.rows.iter().filter(|row| row.walking).collect();
    let counting = Counting::of(record);
    let mut strides = Strides { counted: Vec::new(), uncounted: Vec::new() };
    for stride in FIRST_STRIDE_COUNTED as u32..record.strides {
        let Some(rows) = one(&walking, stride) else { continue };
        let curve = rows.iter().map(|row| value(&row.joints[joint.index()])).collect();
        if rows.iter().all(|row| counting.counts(row)) {
            strides.counted.push(curve);
        } else {
            strides.uncounted.push(curve);
        }
    }
    strides
}

/// Mean of curves point by point; empty when there are none.
#[must_use]
pub fn mean(curves: &[Vec<f64>]) -> Vec<f64> {
    if curves.is_empty() {
        return Vec::new();
    }
    (0..POINTS).map(|i| curves.iter().map(|c| c[i]).sum::<f64>() / curves.len() as f64).collect()
}

/// The rows at 0, 1, .. 100 % of a stride; `None` when the record ends before it does.
fn one<'a>(rows: &[&'a Row], stride: u32) -> Option<Vec<&'a Row>> {
    (0..POINTS)
        .map(|percent| {
            let at = f64::from(stride) + percent as f64 / 100.0;
            let i = rows.partition_point(|row| row.strides_true < at);
            // The very last point of the last stride may lie just beyond the record.
            rows.get(i).or_else(|| rows.last().filter(|last| at - last.strides_true < 0.005)).copied()
        })
        .collect()
}
