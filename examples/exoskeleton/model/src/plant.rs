//! The plant: the person's leg with three motor devices on it. It simulates the hardware, and is no part of
//! the product.
//!
//! The device behind each drive keeps its last torque when its drive falls silent, as real ones do; a
//! watchdog of its own is optional. The contact load is a function of the phase: it does not react to
//! posture.

use crate::chance::Chance;
use crate::intention::{Intended, Intention};
use crate::joint::{Joint, PerJoint};
use crate::leg::{BODY_MASS_KG, GRAVITY_M_S2, Leg, LegState};

/// The person in the device.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct Person {
    /// Share of the biological moment that the muscles still provide, 0..1. Default 0.6: a weak user.
    pub strength: f64,
    /// How stiffly the person holds to the intended angle, Nm/rad. Default 40 / 25 / 25.
    pub stiffness_nm_rad: PerJoint<f64>,
    /// Damping toward the intended velocity, Nms/rad. Default 3 / 2 / 1.5.
    pub damping_nms_rad: PerJoint<f64>,
    /// Passive damping of the tissue relative to the intended velocity, Nms/rad. Default 0.5.
    pub passive_nms_rad: f64,
}

impl Default for Person {
    fn default() -> Self {
        Self {
            strength: 0.6,
            stiffness_nm_rad: [40.0, 25.0, 25.0],
            damping_nms_rad: [3.0, 2.0, 1.5],
            passive_nms_rad: 0.5,
        }
    }
}

/// Parameters of the plant.
///
/// Lag and quantisation are on by default, unlike in the Python reference, because real devices have them and
/// the figures stay within their limits with them; [`PlantConfig::as_reference`] switches them off for
/// comparison.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlantConfig {
    /// The person.
    pub person: Person,
    /// Deviation of the angle noise, rad. Default 0.3 degrees.
    pub angle_noise_rad: f64,
    /// Time constant of the torque, seconds; 0 is an ideal source. Default 5 ms.
    pub torque_lag_s: f64,
    /// Step of the commanded torque, Nm; 0 is none. Default 120 / 4096: 12 bits over -60..60 Nm.
    pub torque_step_nm: f64,
    /// Silence after which a device damps by itself, ns; `None`: it holds its last torque forever. Default `None`.
    pub watchdog_ns: Option<u64>,
    /// Parts into which each step is cut. Default 1; 4 changes the angles by less than 0.1 degree.
    pub substeps: u32,
}

impl Default for PlantConfig {
    fn default() -> Self {
        Self {
            person: Person::default(),
            angle_noise_rad: 0.3_f64.to_radians(),
            torque_lag_s: 0.005,
            torque_step_nm: 120.0 / 4096.0,
            watchdog_ns: None,
            substeps: 1,
        }
    }
}

impl PlantConfig {
    /// Ideal devices without noise, as in the Python reference model.
    #[must_use]
    pub fn as_reference() -> Self {
        Self { angle_noise_rad: 0.0, torque_lag_s: 0.0, torque_step_nm: 0.0, ..Self::default() }
    }
}

/// The reading of the device of one joint.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct DeviceReading {
    /// Angle with noise, rad.
    pub angle_rad: f64,
    /// Velocity, rad/s.
    pub velocity_rad_s: f64,
    /// Torque applied, Nm.
    pub torque_nm: f64,
    /// Whether the device's own watchdog has taken over.
    pub watchdog_active: bool,
}

/// The reading of the sole.
#[derive(Debug, Clone, Copy, PartialEq, Default)]
pub struct FootReading {
    /// Vertical load under the heel, N.
    pub heel_n: f64,
    /// Vertical load under the forefoot, N.
    pub toe_n: f64,
}

/// All readings of one instant.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlantReadings {
    /// Time, ns since the plant was built.
    pub t_ns: u64,
    /// The three devices.
    pub joints: PerJoint<DeviceReading>,
    /// The sole.
    pub foot: FootReading,
}

/// The true state of the plant, unknown to all nodes: for records and metrics.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PlantTruth {
    /// Time, ns since the plant was built.
    pub t_ns: u64,
    /// The motion that the person intends.
    pub intended: Intended,
    /// The true state of the leg.
    pub leg: LegState,
    /// Torques that the devices apply, Nm.
    pub applied_nm: PerJoint<f64>,
    /// Devices that damp by their own watchdogs.
    pub watchdog_active: PerJoint<bool>,
}

/// The plant.
#[derive(Debug, Clone)]
pub struct PlantCore {
    config: PlantConfig,
    leg: Leg,
    intention: Intention,
    noise: Chance,
    t_ns: u64,
    walking_since_ns: Option<u64>,
    state: LegState,
    devices: PerJoint<Device>,
}

impl PlantCore {
    /// Creates a person that stands still in silent devices.
    #[must_use]
    pub fn new(config: PlantConfig, intention: Intention, seed: u64) -> Self {
        let standing = intention.at(-1.0);
        Self {
            config,
            leg: Leg::adult_with_exoskeleton(),
            intention,
            noise: Chance::for_purpose(seed, 2),
            t_ns: 0,
            walking_since_ns: None,
            state: LegState { angle_rad: standing.angle_rad, velocity_rad_s: [0.0; 3] },
            devices: [Device::default(); 3],
        }
    }

    /// The person begins to walk with the next step; the first call counts.
    pub const fn start_walking(&mut self) {
        if self.walking_since_ns.is_none() {
            self.walking_since_ns = Some(self.t_ns);
        }
    }

    /// Sets the leg onto the intended motion of this instant, as if it had been followed perfectly so far.
    pub fn place_on_intention(&mut self) {
        let intended = self.intended();
        self.state = LegState { angle_rad: intended.angle_rad, velocity_rad_s: intended.velocity_rad_s };
    }

    /// Makes a device damp by itself until its next command, with or without a watchdog.
    pub const fn damp(&mut self, joint: Joint) {
        let device = &mut self.devices[joint.index()];
        device.damps = true;
        device.silent_ns = Some(0);
    }

    /// Moves on by `dt_ns` under the commands that arrived (Nm; `None` from a silent drive), then reads.
    pub fn step(&mut self, dt_ns: u64, commands_nm: &PerJoint<Option<f64>>) -> PlantReadings {
        let dt_s = dt_ns as f64 * 1e-9;
        let intended = self.intended();
        for (i, device) in self.devices.iter_mut().enumerate() {
            device.take(commands_nm[i], dt_ns, &self.config);
            device.act(dt_s, self.state.velocity_rad_s[i], &self.config);
        }
        let torque_nm = self.joint_torque_nm(&intended);
        self.state = self.leg.step(self.state, torque_nm, dt_s, self.config.substeps);
        self.t_ns += dt_ns;
        self.read()
    }

    /// The truth, for records.
    #[must_use]
    pub fn truth(&self) -> PlantTruth {
        PlantTruth {
            t_ns: self.t_ns,
            intended: self.intended(),
            leg: self.state,
            applied_nm: self.devices.map(|d| d.applied_nm),
            watchdog_active: self.devices.map(|d| d.watchdog_active(&self.config)),
        }
    }

    /// Reads all devices at this instant; draws new noise.
    pub fn read(&mut self) -> PlantReadings {
        let joints = std::array::from_fn(|i| DeviceReading {
            angle_rad: self.state.angle_rad[i] + self.config.angle_noise_rad * self.noise.normal(),
            velocity_rad_s: self.state.velocity_rad_s[i],
            torque_nm: self.devices[i].applied_nm,
            watchdog_active: self.devices[i].watchdog_active(&self.config),
        });
        PlantReadings { t_ns: self.t_ns, joints, foot: foot_reading(&self.intended()) }
    }

    fn intended(&self) -> Intended {
        let walking_s =
            self.walking_since_ns.map_or(-1.0, |since| self.t_ns.saturating_sub(since) as f64 * 1e-9);
        self.intention.at(walking_s)
    }

    /// Muscles, devices and contact load together, Nm.
    fn joint_torque_nm(&self, intended: &Intended) -> PerJoint<f64> {
        let person = &self.config.person;
        let on_path = LegState { angle_rad: intended.angle_rad, velocity_rad_s: intended.velocity_rad_s };
        let needed_nm = self.leg.inverse_dynamics(&on_path, intended.acceleration_rad_s2);
        std::array::from_fn(|i| {
            let biological_nm = BODY_MASS_KG * intended.moment_nm_per_kg[i];
            // The contact load that makes the measured moments and the measured motion consistent.
            let contact_nm = needed_nm[i] - biological_nm;
            let angle_error = intended.angle_rad[i] - self.state.angle_rad[i];
            let velocity_error = intended.velocity_rad_s[i] - self.state.velocity_rad_s[i];
            person.strength * biological_nm
                + person.stiffness_nm_rad[i] * angle_error
                + (person.damping_nms_rad[i] + person.passive_nms_rad) * velocity_error
                + contact_nm
                + self.devices[i].applied_nm
        })
    }
}

/// The load goes from heel to forefoot over the first 60 % of the cycle; a simplification.
fn foot_reading(intended: &Intended) -> FootReading {
    let load_n = intended.vertical_load_bw * BODY_MASS_KG * GRAVITY_M_S2;
    let x = (intended.strides.rem_euclid(1.0) / 0.6).min(1.0);
    let forefoot = x * x * (3.0 - 2.0 * x);
    FootReading { heel_n: load_n * (1.0 - forefoot), toe_n: load_n * forefoot }
}

const DEVICE_DAMPING_NMS_RAD: f64 = 1.0;
const DEVICE_RATE_NM_S: f64 = 2000.0;

/// A motor device: accepts torque commands, applies torque.
#[derive(Debug, Clone, Copy, Default)]
struct Device {
    command_nm: f64,
    applied_nm: f64,
    /// Silence since the last command, ns; `None` before the first.
    silent_ns: Option<u64>,
    /// Ordered to damp by itself.
    damps: bool,
}

impl Device {
    fn take(&mut self, command_nm: Option<f64>, dt_ns: u64, config: &PlantConfig) {
        match command_nm.filter(|c| c.is_finite()) {
            Some(command_nm) => {
                let step = config.torque_step_nm;
                self.command_nm = if step > 0.0 { (command_nm / step).round() * step } else { command_nm };
                self.silent_ns = Some(0);
                self.damps = false;
            }
            None => self.silent_ns = self.silent_ns.map(|s| s.saturating_add(dt_ns)),
        }
    }

    fn watchdog_active(&self, config: &PlantConfig) -> bool {
        match (config.watchdog_ns, self.silent_ns) {
            (Some(limit_ns), Some(silent_ns)) => silent_ns > limit_ns,
            (Some(_) | None, _) => false,
        }
    }

    fn act(&mut self, dt_s: f64, velocity_rad_s: f64, config: &PlantConfig) {
        if self.damps || self.watchdog_active(config) {
            let wanted = -DEVICE_DAMPING_NMS_RAD * velocity_rad_s;
            let step = DEVICE_RATE_NM_S * dt_s;
            self.command_nm += (wanted - self.command_nm).clamp(-step, step);
        }
        let share = if config.torque_lag_s > 0.0 { 1.0 - (-dt_s / config.torque_lag_s).exp() } else { 1.0 };
        self.applied_nm += share * (self.command_nm - self.applied_nm);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const MS: u64 = 1_000_000;

    fn plant(config: PlantConfig) -> PlantCore {
        PlantCore::new(config, Intention::from_curves(1), 1)
    }

    #[test]
    fn healthy_person_without_assistance_walks_the_intended_motion() {
        let person = Person { strength: 1.0, ..Person::default() };
        let mut plant = plant(PlantConfig { person, ..PlantConfig::as_reference() });
        plant.start_walking();
        let mut worst = 0.0_f64;
        for _ in 0..5_000 {
            plant.step(MS, &[None; 3]);
            let truth = plant.truth();
            for i in 0..3 {
                worst = worst.max((truth.leg.angle_rad[i] - truth.intended.angle_rad[i]).abs().to_degrees());
            }
        }
        assert!(worst < 1.0, "worst {worst} deg");
    }

    #[test]
    fn silent_drive_leaves_its_last_torque_on_the_device() {
        let mut plant = plant(PlantConfig::as_reference());
        plant.step(MS, &[Some(7.0), None, None]);
        for _ in 0..100 {
            plant.step(MS, &[None; 3]);
        }
        assert_eq!(plant.truth().applied_nm, [7.0, 0.0, 0.0]);
    }

    #[test]
    fn device_watchdog_replaces_the_held_torque_by_damping() {
        let mut plant = plant(PlantConfig { watchdog_ns: Some(10 * MS), ..PlantConfig::as_reference() });
        plant.step(MS, &[Some(7.0), None, None]);
        for _ in 0..1000 {
            plant.step(MS, &[None; 3]);
        }
        let truth = plant.truth();
        assert!((truth.applied_nm[0] + truth.leg.velocity_rad_s[0]).abs() < 0.1);
        assert!(plant.read().joints[0].watchdog_active);
    }

    #[test]
    fn ordered_damping_lasts_until_the_next_command() {
        let mut plant = plant(PlantConfig::as_reference());
        plant.step(MS, &[Some(40.0), None, None]);
        plant.damp(Joint::Hip);
        let mut before = 40.0;
        for _ in 0..1000 {
            plant.step(MS, &[None; 3]);
            let now = plant.truth().applied_nm[0];
            assert!(f64::abs(now - before) < 2.0 + 1e-9, "no quicker than it may: {before} to {now}");
            before = now;
        }
        let truth = plant.truth();
        assert!((truth.applied_nm[0] + truth.leg.velocity_rad_s[0]).abs() < 0.1);
        assert!(!plant.read().joints[0].watchdog_active, "it was ordered to damp");
        plant.step(MS, &[Some(3.0), None, None]);
        plant.step(MS, &[None; 3]);
        assert_eq!(plant.truth().applied_nm[0], 3.0);
    }

    #[test]
    fn nan_command_is_ignored() {
        let mut plant = plant(PlantConfig::as_reference());
        plant.step(MS, &[Some(3.0), Some(f64::NAN), None]);
        assert_eq!(plant.truth().applied_nm, [3.0, 0.0, 0.0]);
    }
}
