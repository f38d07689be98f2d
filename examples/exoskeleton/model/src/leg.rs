//! Equations of motion of thigh, shank and foot, hip pinned, with the exoskeleton's masses.
//!
//! Segment angles run from the downward vertical, forward positive:
//! `t1 = hip`, `t2 = hip - knee`, `t3 = hip - knee + 90 deg + ankle`.

use crate::joint::PerJoint;

/// Acceleration of gravity, m/s2.
pub const GRAVITY_M_S2: f64 = 9.81;
/// Mass of the person, kg.
pub const BODY_MASS_KG: f64 = 80.0;
/// Height of the person, m.
pub const BODY_HEIGHT_M: f64 = 1.78;

/// How segment angles follow from joint angles (without the constant of the foot).
const SEGMENT_FROM_JOINT: [[f64; 3]; 3] = [[1.0, 0.0, 0.0], [1.0, -1.0, 0.0], [1.0, -1.0, 1.0]];

/// Ends of the joint ranges, rad: hip -35..100, knee -6..100, ankle -40..25 degrees, as in the reference model.
pub const RANGE_RAD: PerJoint<(f64, f64)> = [(-0.61, 1.75), (-0.10, 1.75), (-0.70, 0.44)];
const STOP_STIFFNESS_NM_RAD: f64 = 400.0;
const STOP_DAMPING_NMS_RAD: f64 = 8.0;

/// Angles and velocities of the three joints.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct LegState {
    /// Joint angles, rad.
    pub angle_rad: PerJoint<f64>,
    /// Joint velocities, rad/s.
    pub velocity_rad_s: PerJoint<f64>,
}

/// Masses, lengths and inertias of the leg with the exoskeleton on it.
#[derive(Debug, Clone, PartialEq)]
pub struct Leg {
    /// Diagonal of the segment mass matrix, kg m2.
    inertia: [f64; 3],
    /// Couplings thigh-shank, thigh-foot, shank-foot, kg m2.
    coupling: [f64; 3],
    /// Weight moments of the segments, Nm.
    weight: [f64; 3],
    /// Reflected inertia of the actuators, kg m2.
    actuator: PerJoint<f64>,
}

impl Leg {
    /// The 80 kg, 1.78 m adult (segment shares from Winter's table after Dempster). The exoskeleton adds 1.8, 1.5
    /// and 1.0 kg at the segments' centres, and 0.10, 0.10 and 0.06 kg m2 of reflected actuator inertia.
    #[must_use]
    pub fn adult_with_exoskeleton() -> Self {
        let length = [0.245 * BODY_HEIGHT_M, 0.246 * BODY_HEIGHT_M];
        // Ankle to second metatarsal head: 0.6 of the foot's length.
        let foot = 0.6 * 0.152 * BODY_HEIGHT_M;
        let centre = [0.433 * length[0], 0.433 * length[1], 0.5 * foot];
        let gyration = [0.323 * length[0], 0.302 * length[1], 0.475 * foot];
        let share = [0.100, 0.0465, 0.0145];
        let device_kg = [1.8, 1.5, 1.0];
        let mass: [f64; 3] = std::array::from_fn(|i| share[i] * BODY_MASS_KG + device_kg[i]);
        let own: [f64; 3] =
            std::array::from_fn(|i| share[i] * BODY_MASS_KG * gyration[i].powi(2) + device_kg[i] * 0.01);
        let carried = [mass[1] + mass[2], mass[2]];
        let first = [
            mass[0] * centre[0] + carried[0] * length[0],
            mass[1] * centre[1] + carried[1] * length[1],
            mass[2] * centre[2],
        ];
        Self {
            inertia: [
                own[0] + mass[0] * centre[0].powi(2) + carried[0] * length[0].powi(2),
                own[1] + mass[1] * centre[1].powi(2) + carried[1] * length[1].powi(2),
                own[2] + mass[2] * centre[2].powi(2),
            ],
            coupling: [first[1] * length[0], first[2] * length[0], first[2] * length[1]],
            weight: first.map(|moment| moment * GRAVITY_M_S2),
            actuator: [0.10, 0.10, 0.06],
        }
    }

    /// Mass matrix (kg m2) and the torques of gravity and centrifugal force (Nm) in joint coordinates.
    #[must_use]
    pub fn dynamics(&self, state: &LegState) -> ([[f64; 3]; 3], PerJoint<f64>) {
        let (q, w) = (state.angle_rad, to_segments(state.velocity_rad_s));
        let mut t = to_segments(q);
        t[2] += std::f64::consts::FRAC_PI_2;
        let [k12, k13, k23] = self.coupling;
        let (a12, a13, a23) =
            (k12 * (t[0] - t[1]).cos(), k13 * (t[0] - t[2]).cos(), k23 * (t[1] - t[2]).cos());
        let (s12, s13, s23) =
            (k12 * (t[0] - t[1]).sin(), k13 * (t[0] - t[2]).sin(), k23 * (t[1] - t[2]).sin());
        let [i1, i2, i3] = self.inertia;
        let segment = [[i1, a12, a13], [a12, i2, a23], [a13, a23, i3]];
        let w2 = w.map(|x| x * x);
        let bias = [
            s12 * w2[1] + s13 * w2[2] + self.weight[0] * t[0].sin(),
            -s12 * w2[0] + s23 * w2[2] + self.weight[1] * t[1].sin(),
            -s13 * w2[0] - s23 * w2[1] + self.weight[2] * t[2].sin(),
        ];
        let mut mass = congruent(&segment);
        for (i, actuator) in self.actuator.iter().enumerate() {
            mass[i][i] += actuator;
        }
        (mass, to_joints(bias))
    }

    /// Joint torques (Nm) that move the leg with `acceleration_rad_s2` from `state`.
    #[must_use]
    pub fn inverse_dynamics(&self, state: &LegState, acceleration_rad_s2: PerJoint<f64>) -> PerJoint<f64> {
        let (mass, bias) = self.dynamics(state);
        std::array::from_fn(|i| bias[i] + (0..3).map(|j| mass[i][j] * acceleration_rad_s2[j]).sum::<f64>())
    }

    /// One step of `dt_s` under constant joint torques (Nm): semi-implicit Euler in `substeps` equal parts.
    /// The stops at the ends of the joint ranges act on top.
    #[must_use]
    pub fn step(&self, state: LegState, torque_nm: PerJoint<f64>, dt_s: f64, substeps: u32) -> LegState {
        let h = dt_s / f64::from(substeps.max(1));
        let mut state = state;
        for _ in 0..substeps.max(1) {
            let (mass, bias) = self.dynamics(&state);
            let stop = stop_torque_nm(&state);
            let net = std::array::from_fn(|i| torque_nm[i] + stop[i] - bias[i]);
            let acceleration = solve_symmetric(&mass, net);
            for (i, acceleration) in acceleration.iter().enumerate() {
                state.velocity_rad_s[i] += h * acceleration;
                state.angle_rad[i] += h * state.velocity_rad_s[i];
            }
        }
        state
    }

    /// Kinetic plus potential energy, J; constant when no torque acts.
    #[must_use]
    pub fn energy_j(&self, state: &LegState) -> f64 {
        let (mass, _) = self.dynamics(state);
        let v = state.velocity_rad_s;
        let kinetic: f64 = (0..3).map(|i| (0..3).map(|j| 0.5 * v[i] * mass[i][j] * v[j]).sum::<f64>()).sum();
        let mut t = to_segments(state.angle_rad);
        t[2] += std::f64::consts::FRAC_PI_2;
        kinetic - (0..3).map(|i| self.weight[i] * t[i].cos()).sum::<f64>()
    }
}

/// One-sided spring and damper beyond the ends of the joint ranges, Nm.
#[must_use]
pub fn stop_torque_nm(state: &LegState) -> PerJoint<f64> {
    std::array::from_fn(|i| {
        let (low, high) = RANGE_RAD[i];
        let (angle, velocity) = (state.angle_rad[i], state.velocity_rad_s[i]);
        let beyond = (angle - low).min(0.0) + (angle - high).max(0.0);
        if beyond == 0.0 { 0.0 } else { -STOP_STIFFNESS_NM_RAD * beyond - STOP_DAMPING_NMS_RAD * velocity }
    })
}

fn to_segments(joint: PerJoint<f64>) -> [f64; 3] {
    [joint[0], joint[0] - joint[1], joint[0] - joint[1] + joint[2]]
}

fn to_joints(segment: [f64; 3]) -> PerJoint<f64> {
    [segment[0] + segment[1] + segment[2], -segment[1] - segment[2], segment[2]]
}

/// `T' A T` for the segment matrix A.
fn congruent(segment: &[[f64; 3]; 3]) -> [[f64; 3]; 3] {
    let t = &SEGMENT_FROM_JOINT;
    std::array::from_fn(|i| {
        std::array::from_fn(|j| {
            (0..3).map(|k| (0..3).map(|l| t[k][i] * segment[k][l] * t[l][j]).sum::<f64>()).sum()
        })
    })
}

/// Solves `a x = b` for a symmetric positive definite 3x3 matrix by elimination.
fn solve_symmetric(a: &[[f64; 3]; 3], b: [f64; 3]) -> [f64; 3] {
    let l21 = a[1][0] / a[0][0];
    let l31 = a[2][0] / a[0][0];
    let d2 = a[1][1] - l21 * a[0][1];
    let u23 = a[1][2] - l21 * a[0][2];
    let l32 = u23 / d2;
    let d3 = a[2][2] - l31 * a[0][2] - l32 * u23;
    let y2 = b[1] - l21 * b[0];
    let x3 = (b[2] - l31 * b[0] - l32 * y2) / d3;
    let x2 = (y2 - u23 * x3) / d2;
    [(b[0] - a[0][1] * x2 - a[0][2] * x3) / a[0][0], x2, x3]
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn free_leg_keeps_its_energy() {
        let leg = Leg::adult_with_exoskeleton();
        let mut state = LegState { angle_rad: [0.4, 0.6, -0.1], velocity_rad_s: [0.0; 3] };
        let start = leg.energy_j(&state);
        for _ in 0..100 {
            // Short enough that no joint reaches its stop.
            state = leg.step(state, [0.0; 3], 1e-3, 20);
        }
        assert!((leg.energy_j(&state) - start).abs() < 0.05, "drift {} J", leg.energy_j(&state) - start);
    }

    #[test]
    fn step_under_inverse_dynamics_gives_the_wanted_acceleration() {
        let leg = Leg::adult_with_exoskeleton();
        let state = LegState { angle_rad: [0.3, 0.5, 0.1], velocity_rad_s: [1.0, -2.0, 0.5] };
        let wanted = [3.0, -4.0, 5.0];
        let next = leg.step(state, leg.inverse_dynamics(&state, wanted), 1e-3, 1);
        for (i, wanted) in wanted.iter().enumerate() {
            assert!(((next.velocity_rad_s[i] - state.velocity_rad_s[i]) / 1e-3 - wanted).abs() < 1e-9);
        }
    }

    #[test]
    fn stops_push_back_into_the_range() {
        let beyond = LegState { angle_rad: [2.0, -0.3, 0.0], velocity_rad_s: [0.0; 3] };
        let torque = stop_torque_nm(&beyond);
        assert!(torque[0] < 0.0 && torque[1] > 0.0 && torque[2] == 0.0);
    }
}
