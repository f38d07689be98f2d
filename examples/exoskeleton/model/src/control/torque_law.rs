//! The assistance of one joint: a share of the biological moment plus a soft spring and damper on the reference.

use serde::{Deserialize, Serialize};

use crate::gait::curves;
use crate::joint::Joint;

/// Parameters of the torque law for one joint.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct TorqueLaw {
    /// The joint that gives the curves.
    pub joint: Joint,
    /// The gains, which may change while the leg walks.
    pub gains: Gains,
    /// Mass of the person, kg; scales the moment curves.
    pub body_mass_kg: f64,
    /// Largest torque, Nm. Default 45 / 45 / 60.
    pub limit_nm: f64,
}

/// The gains of a torque law.
#[derive(Debug, Clone, Copy, PartialEq, Serialize, Deserialize)]
pub struct Gains {
    /// Share of the biological moment that the device provides, 0..1. Default 0.4.
    pub assistance: f64,
    /// Stiffness toward the reference angle, Nm/rad. Default 120 / 100 / 80.
    pub stiffness_nm_rad: f64,
    /// Damping toward the reference velocity, Nms/rad. Default 6 / 5 / 3.
    pub damping_nms_rad: f64,
}

impl Gains {
    /// Returns these gains, all multiplied by this factor.
    #[must_use]
    pub const fn times(self, factor: f64) -> Self {
        Self {
            assistance: self.assistance * factor,
            stiffness_nm_rad: self.stiffness_nm_rad * factor,
            damping_nms_rad: self.damping_nms_rad * factor,
        }
    }
}

/// The phase for the law: its inputs are slightly old, and its torque acts slightly later.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LawPhase {
    /// Phase when angle and velocity were measured, cycles: for the reference that they are compared with.
    pub at_sample: f64,
    /// Phase when the torque will act, cycles: for the moment that is fed forward.
    pub at_effect: f64,
    /// Phase rate, cycles per second.
    pub rate_hz: f64,
}

/// A torque within the limit, and whether the limit was reached.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LimitedTorque {
    /// Torque, Nm.
    pub torque_nm: f64,
    /// Whether the law's torque was at the limit or above.
    pub saturated: bool,
}

impl TorqueLaw {
    /// The law of the domain notes for an 80 kg adult.
    #[must_use]
    pub const fn standard(joint: Joint) -> Self {
        let (stiffness_nm_rad, damping_nms_rad, limit_nm) = match joint {
            Joint::Hip => (120.0, 6.0, 45.0),
            Joint::Knee => (100.0, 5.0, 45.0),
            Joint::Ankle => (80.0, 3.0, 60.0),
        };
        Self {
            joint,
            gains: Gains { assistance: 0.4, stiffness_nm_rad, damping_nms_rad },
            body_mass_kg: crate::leg::BODY_MASS_KG,
            limit_nm,
        }
    }

    /// Torque for the measured angle (rad) and velocity (rad/s).
    #[must_use]
    pub fn torque(&self, phase: &LawPhase, angle_rad: f64, velocity_rad_s: f64) -> LimitedTorque {
        self.torque_around(self.feed_forward_nm(phase.at_effect), phase, angle_rad, velocity_rad_s)
    }

    /// The share of the biological moment that is fed forward at a phase, Nm.
    #[must_use]
    pub fn feed_forward_nm(&self, phase: f64) -> f64 {
        self.gains.assistance * self.body_mass_kg * curves::moment_nm_per_kg(self.joint, phase)
    }

    /// As [`TorqueLaw::torque`], around another fed-forward moment, Nm.
    #[must_use]
    pub fn torque_around(
        &self,
        feed_forward_nm: f64,
        phase: &LawPhase,
        angle_rad: f64,
        velocity_rad_s: f64,
    ) -> LimitedTorque {
        let reference = curves::angle_rad(self.joint, phase.at_sample);
        let wanted = feed_forward_nm
            + self.gains.stiffness_nm_rad * (reference.value - angle_rad)
            + self.gains.damping_nms_rad * (reference.slope * phase.rate_hz - velocity_rad_s);
        LimitedTorque {
            torque_nm: wanted.clamp(-self.limit_nm, self.limit_nm),
            saturated: wanted.abs() >= self.limit_nm,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const HALF_WAY: LawPhase = LawPhase { at_sample: 0.5, at_effect: 0.5, rate_hz: 0.75 };

    #[test]
    fn limit_is_never_exceeded() {
        for joint in Joint::ALL {
            let law = TorqueLaw::standard(joint);
            for angle in [-3.0, 0.0, 3.0] {
                let torque = law.torque(&HALF_WAY, angle, -10.0 * angle);
                assert!(torque.torque_nm.abs() <= law.limit_nm);
            }
        }
    }

    #[test]
    fn leg_on_the_reference_gets_its_share_of_moment() {
        let law = TorqueLaw::standard(Joint::Ankle);
        let on = curves::angle_rad(Joint::Ankle, 0.5);
        let torque = law.torque(&HALF_WAY, on.value, on.slope * 0.75);
        let share = 0.4 * 80.0 * curves::moment_nm_per_kg(Joint::Ankle, 0.5);
        assert!((torque.torque_nm - share).abs() < 1e-9 && share < -40.0, "{share}");
    }
}
