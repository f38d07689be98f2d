//! Cuts a record into strides of 101 points by the true phase.

use crate::joint::Joint;
use crate::metrics::FIRST_STRIDE_COUNTED;
use crate::record::{JointRow, Record, Row};

/// Points of a stride: 0, 1, .. 100 % of the cycle.
pub(super) const POINTS: usize = 101;

/// One curve per whole stride that counts, from `value` of a joint.
pub(super) fn curves(record: &Record, joint: Joint, value: impl Fn(&JointRow) -> f64) -> Vec<Vec<f64>> {
    let walking: Vec<&Row> = record.rows.iter().filter(|row| row.walking).collect();
    let first =
        if f64::from(record.strides) > FIRST_STRIDE_COUNTED { FIRST_STRIDE_COUNTED as u32 } else { 0 };
    (first..record.strides).filter_map(|stride| one(&walking, joint, stride, &value)).collect()
}

/// Mean of curves point by point; empty when there are none.
pub(super) fn mean(curves: &[Vec<f64>]) -> Vec<f64> {
    if curves.is_empty() {
        return Vec::new();
    }
    (0..POINTS).map(|i| curves.iter().map(|c| c[i]).sum::<f64>() / curves.len() as f64).collect()
}

fn one(rows: &[&Row], joint: Joint, stride: u32, value: impl Fn(&JointRow) -> f64) -> Option<Vec<f64>> {
    (0..POINTS)
        .map(|percent| {
            let at = f64::from(stride) + percent as f64 / 100.0;
            let i = rows.partition_point(|row| row.strides_true < at);
            // The very last point of the last stride may lie just beyond the record.
            let row = rows.get(i).or_else(|| rows.last().filter(|last| at - last.strides_true < 0.005))?;
            Some(value(&row.joints[joint.index()]))
        })
        .collect()
}
