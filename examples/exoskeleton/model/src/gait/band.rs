//! The reference band of the plots: mean and stride-to-stride deviation of the recorded strides.

use super::table::{Table, TableError};
use crate::joint::PerJoint;

/// Mean and deviation of one joint angle at one per cent of the cycle, degrees.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct BandPoint {
    /// Mean over the strides, degrees.
    pub mean_deg: f64,
    /// Standard deviation from stride to stride, degrees.
    pub deviation_deg: f64,
}

/// The band of the three joint angles at 0, 1, .. 100 % of the cycle.
#[derive(Debug, Clone)]
pub struct Band {
    points: PerJoint<Vec<BandPoint>>,
}

impl Band {
    /// The band of the built-in recording (`data/gait_reference.csv`).
    #[must_use]
    pub fn built_in() -> Self {
        Self::parse(include_str!("../../../data/gait_reference.csv"))
            .expect("the built-in file is parsed by a test")
    }

    /// Reads a band from a CSV text with the columns of `data/gait_reference.csv`.
    ///
    /// # Errors
    /// [`TableError`] when a column is missing or a line is no row of numbers.
    pub fn parse(text: &str) -> Result<Self, TableError> {
        let columns = ["hip_deg", "knee_deg", "ankle_deg", "hip_deg_sd", "knee_deg_sd", "ankle_deg_sd"];
        let table = Table::parse(text, &columns)?;
        let points = std::array::from_fn(|joint| {
            table
                .rows()
                .iter()
                .map(|row| BandPoint { mean_deg: row.values[joint], deviation_deg: row.values[3 + joint] })
                .collect()
        });
        Ok(Self { points })
    }

    /// Points of one joint at 0, 1, .. 100 % of the cycle.
    #[must_use]
    pub fn joint(&self, joint: crate::joint::Joint) -> &[BandPoint] {
        &self.points[joint.index()]
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::joint::Joint;

    #[test]
    fn built_in_band_covers_the_whole_cycle() {
        let band = Band::built_in();
        for joint in Joint::ALL {
            assert_eq!(band.joint(joint).len(), 101);
            assert!(band.joint(joint).iter().all(|p| p.deviation_deg > 0.0 && p.mean_deg.abs() < 90.0));
        }
    }
}
