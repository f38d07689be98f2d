//! The gains of each drive as parameters: `sinew param` shows them, and sets them while the leg walks.
//!
//! - The defaults are the gains of the standard torque law.
//! - The least damping is 1 Nms/rad. A torque follows its order by 6 ms, so that a spring of 150 Nm/rad adds energy as
//!   a negative damping of 150 * 0.006 = 0.9 Nms/rad.
//! - The greatest gains of the feedback are 1.25 times the defaults. With the inertia of its motor alone, 0.10 kg m2,
//!   the hip then has a crossover at 7.5 / 0.10 = 75 rad/s, where 6 ms are a lag of 26 degrees.
//! - The slopes change the torque by some tens of Nm per second. The limits of torque and rate hold for all gains.
//! - A drive that its supervisor restarts keeps its gains: it continues to assist the same person.

use exoskeleton_model::control::torque_law::{Gains, TorqueLaw};
use exoskeleton_model::joint::Joint;
use sinew::parameters::Parameters;
use sinew::params;

/// The parameters of a drive.
pub(super) trait DriveGains: Parameters {
    /// Returns the present gains. Those that one tick reads belong together.
    fn get(&self) -> Gains;
}

/// Declares the parameters of the drive of one joint: a default is a constant.
macro_rules! drive_gains {
    ($name:ident, $joint:expr) => {
        params! {
            /// The gains of the drive of one joint.
            pub(super) struct $name {
                /// Share of the biological moment that the drive adds.
                assistance: f64 = standard($joint).assistance, unit "1", range 0.0..=0.6, slope 0.5, keep;
                /// Stiffness toward the reference angle.
                stiffness: f64 = standard($joint).stiffness_nm_rad, unit "Nm/rad",
                    range 0.0..=1.25 * standard($joint).stiffness_nm_rad, slope 100.0, keep;
                /// Damping toward the reference velocity.
                damping: f64 = standard($joint).damping_nms_rad, unit "Nms/rad",
                    range 1.0..=1.25 * standard($joint).damping_nms_rad, slope 5.0, keep;
            }
        }

        impl DriveGains for $name {
            fn get(&self) -> Gains {
                Gains {
                    assistance: self.assistance.get(),
                    stiffness_nm_rad: self.stiffness.get(),
                    damping_nms_rad: self.damping.get(),
                }
            }
        }
    };
}

const fn standard(joint: Joint) -> Gains {
    TorqueLaw::standard(joint).gains
}

drive_gains!(HipGains, Joint::Hip);
drive_gains!(KneeGains, Joint::Knee);
drive_gains!(AnkleGains, Joint::Ankle);
