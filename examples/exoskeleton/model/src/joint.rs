//! The three powered joints of one leg, and values kept one per joint.
//!
//! Signs are the same everywhere: hip flexion, knee flexion and ankle dorsiflexion are positive. A torque is
//! positive in the direction of its angle, so that power is torque times velocity without a sign table.

use std::fmt;

/// One powered joint, counted from the trunk down.
#[derive(Debug, Clone, Copy, PartialEq, Eq, PartialOrd, Ord, Hash, serde::Serialize, serde::Deserialize)]
#[serde(rename_all = "lowercase")]
pub enum Joint {
    /// Between trunk and thigh; flexion is positive.
    Hip,
    /// Between thigh and shank; flexion is positive.
    Knee,
    /// Between shank and foot; dorsiflexion is positive.
    Ankle,
}

/// A value for each joint, in the order of [`Joint::ALL`].
pub type PerJoint<T> = [T; 3];

impl Joint {
    /// All joints, from the trunk down.
    pub const ALL: PerJoint<Self> = [Self::Hip, Self::Knee, Self::Ankle];

    /// Place of this joint in a [`PerJoint`].
    #[must_use]
    pub const fn index(self) -> usize {
        match self {
            Self::Hip => 0,
            Self::Knee => 1,
            Self::Ankle => 2,
        }
    }

    /// Lower-case English name, as in file columns and on the command line.
    #[must_use]
    pub const fn name(self) -> &'static str {
        match self {
            Self::Hip => "hip",
            Self::Knee => "knee",
            Self::Ankle => "ankle",
        }
    }
}

impl fmt::Display for Joint {
    fn fmt(&self, f: &mut fmt::Formatter<'_>) -> fmt::Result {
        f.write_str(self.name())
    }
}
