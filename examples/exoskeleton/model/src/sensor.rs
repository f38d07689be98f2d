//! The sensor of one joint: a reading of the device becomes a numbered, stamped sample.

use crate::message::{FootLoad, JointSample};
use crate::plant::{DeviceReading, FootReading};

/// Parameters of a sensor.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct SensorConfig {
    /// Step of the encoder, rad; 0 means none. Default 0.05 degrees. Its noise comes from the device itself.
    pub encoder_step_rad: f64,
}

impl Default for SensorConfig {
    fn default() -> Self {
        Self { encoder_step_rad: 0.05_f64.to_radians() }
    }
}

/// The sensor of one joint.
#[derive(Debug, Clone)]
pub struct SensorCore {
    config: SensorConfig,
    sample_seq: u32,
    load_seq: u32,
}

impl SensorCore {
    /// A sensor that starts to count at 0.
    #[must_use]
    pub const fn new(config: SensorConfig) -> Self {
        Self { config, sample_seq: 0, load_seq: 0 }
    }

    /// The sample for a reading made at `t_ns`.
    pub fn sample(&mut self, t_ns: u64, reading: &DeviceReading) -> JointSample {
        let seq = self.sample_seq;
        self.sample_seq = seq.wrapping_add(1);
        let step = self.config.encoder_step_rad;
        let angle = reading.angle_rad;
        let angle_rad = if step > 0.0 { (angle / step).round() * step } else { angle };
        JointSample {
            seq,
            t_ns,
            t_error_ns: Some(0),
            angle_rad: angle_rad as f32,
            velocity_rad_s: reading.velocity_rad_s as f32,
            torque_nm: reading.torque_nm as f32,
            temperature_c: 30,
            flags: u8::from(reading.watchdog_active),
        }
    }

    /// The foot load for a reading of the sole made at `t_ns` (ankle only).
    pub fn foot_load(&mut self, t_ns: u64, reading: &FootReading) -> FootLoad {
        let seq = self.load_seq;
        self.load_seq = seq.wrapping_add(1);
        FootLoad {
            seq,
            t_ns,
            t_error_ns: Some(0),
            heel_n: reading.heel_n as f32,
            toe_n: reading.toe_n as f32,
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn angle_comes_in_encoder_steps_and_samples_are_numbered() {
        let mut sensor = SensorCore::new(SensorConfig::default());
        let reading = DeviceReading { angle_rad: 0.123_456, ..DeviceReading::default() };
        let (a, b) = (sensor.sample(1, &reading), sensor.sample(2, &reading));
        let steps = f64::from(a.angle_rad).to_degrees() / 0.05;
        assert!((steps - steps.round()).abs() < 1e-3);
        assert_eq!((a.seq, b.seq), (0, 1));
    }
}
