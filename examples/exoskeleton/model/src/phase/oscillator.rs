//! Adaptive frequency oscillator on the hip angle (the form of Ronsse et al. 2011), zeroed by heel strikes.
//!
//! `F = angle - (a0 + sum a_k sin p_k)`, `dp_k = k w + nu F/S cos p_k`, `dw = mu F/S cos p_1`, `da_k = eta F sin p_k`,
//! `da0 = eta F`, `S = sum |a_k|`, for k = 1..4. At a heel strike the offset between `p_1` and the gait phase moves
//! half way to the truth, smoothed over 0.25 s.

use std::f64::consts::{PI, TAU};

use super::PhaseEstimate;
use super::heel_strike::HeelStrikeDetector;

const HARMONICS: usize = 4;

/// Gains of the oscillator; the defaults are those of the domain notes.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct OscillatorGains {
    /// Phase gain, 1/s. Higher follows faster and lets more noise through.
    pub phase: f64,
    /// Frequency gain, 1/s2.
    pub frequency: f64,
    /// Amplitude gain, 1/s.
    pub amplitude: f64,
    /// Frequency at the start, rad/s.
    pub start_rad_s: f64,
    /// Share of the phase error that is corrected at each heel strike, 0..1.
    pub strike: f64,
    /// Time constant over which a correction is applied, seconds.
    pub smoothing_s: f64,
}

impl Default for OscillatorGains {
    fn default() -> Self {
        Self {
            phase: 5.0,
            frequency: 2.0,
            amplitude: 2.0,
            start_rad_s: TAU * 0.9,
            strike: 0.5,
            smoothing_s: 0.25,
        }
    }
}

/// The estimator. Call it in each tick; it is cold for about three strides.
#[derive(Debug, Clone)]
pub struct Oscillator {
    gains: OscillatorGains,
    amplitude_deg: [f64; HARMONICS],
    phase_rad: [f64; HARMONICS],
    mean_deg: Option<f64>,
    rate_rad_s: f64,
    offset_rad: f64,
    offset_target_rad: f64,
    strikes: HeelStrikeDetector,
    zeroed: bool,
}

impl Oscillator {
    /// A cold oscillator.
    #[must_use]
    pub fn new(gains: OscillatorGains) -> Self {
        Self {
            gains,
            amplitude_deg: [5.0, 0.0, 0.0, 0.0],
            phase_rad: [0.0; HARMONICS],
            mean_deg: None,
            rate_rad_s: gains.start_rad_s,
            offset_rad: 0.0,
            offset_target_rad: 0.0,
            strikes: HeelStrikeDetector::default(),
            zeroed: false,
        }
    }

    /// Takes hip angle (degrees) and vertical load (body weights), `dt_s` after the last ones.
    pub fn tick(&mut self, hip_deg: f64, load_bw: f64, dt_s: f64) -> PhaseEstimate {
        self.adapt(hip_deg, dt_s);
        let strike_error = self.strikes.tick(load_bw, dt_s).and_then(|_| self.correct());
        self.offset_rad += dt_s * (self.offset_target_rad - self.offset_rad) / self.gains.smoothing_s;
        PhaseEstimate {
            phase: ((self.phase_rad[0] + self.offset_rad) / TAU).rem_euclid(1.0),
            rate_hz: self.rate_rad_s / TAU,
            strike_error,
        }
    }

    /// Advances time without inputs: it oscillates on at its rate and learns nothing.
    pub fn coast(&mut self, dt_s: f64) {
        for (k, phase) in self.phase_rad.iter_mut().enumerate() {
            *phase += dt_s * (k + 1) as f64 * self.rate_rad_s;
        }
        self.strikes.coast(dt_s);
    }

    /// Time since the last heel strike, seconds; `None` before the first.
    #[must_use]
    pub const fn since_strike_s(&self) -> Option<f64> {
        self.strikes.since_strike_s()
    }

    fn adapt(&mut self, hip_deg: f64, dt_s: f64) {
        let mean_deg = *self.mean_deg.get_or_insert(hip_deg);
        let waves = self.phase_rad.map(f64::sin);
        let estimate = mean_deg + waves.iter().zip(&self.amplitude_deg).map(|(s, a)| s * a).sum::<f64>();
        let error = hip_deg - estimate;
        // At least two degrees, so that a leg at rest does not cause a division by zero.
        let scale = self.amplitude_deg.iter().map(|a| a.abs()).sum::<f64>().max(2.0);
        for (k, phase) in self.phase_rad.iter_mut().enumerate() {
            *phase +=
                dt_s * ((k + 1) as f64 * self.rate_rad_s + self.gains.phase * error / scale * phase.cos());
        }
        self.rate_rad_s += dt_s * self.gains.frequency * error / scale * self.phase_rad[0].cos();
        // A stride lasts 0.63 to 3.1 seconds.
        self.rate_rad_s = self.rate_rad_s.clamp(2.0, 10.0);
        self.mean_deg = Some(mean_deg + dt_s * self.gains.amplitude * error);
        for (amplitude, phase) in self.amplitude_deg.iter_mut().zip(&self.phase_rad) {
            *amplitude += dt_s * self.gains.amplitude * error * phase.sin();
        }
    }

    /// Moves the offset toward "phase zero is now" and returns the error in cycles; the first strike sets it.
    fn correct(&mut self) -> Option<f64> {
        let error = (-self.phase_rad[0] - self.offset_target_rad + PI).rem_euclid(TAU) - PI;
        if self.zeroed {
            self.offset_target_rad += self.gains.strike * error;
            return Some(error / TAU);
        }
        self.zeroed = true;
        self.offset_target_rad += error;
        self.offset_rad = self.offset_target_rad;
        None
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gait::curves;
    use crate::joint::Joint;
    use crate::phase::wrapped;

    #[test]
    fn oscillator_keeps_the_phase_over_100_ms_without_input() {
        let mut oscillator = Oscillator::new(OscillatorGains::default());
        let mut ms = 0;
        while ms < 16_000 {
            ms += 1;
            if ms == 14_300 {
                oscillator.coast(0.1);
                ms += 100;
            }
            let strides = f64::from(ms) * 1e-3 / curves::STRIDE_MEAN_S;
            let hip_deg = curves::angle_rad(Joint::Hip, strides).value.to_degrees();
            let estimate = oscillator.tick(hip_deg, curves::vertical_load_bw(strides), 1e-3);
            if strides > 6.0 {
                let error = wrapped(estimate.phase - strides);
                assert!(error.abs() < 0.06, "{error} at stride {strides}");
            }
        }
    }

    #[test]
    fn cold_oscillator_knows_the_phase_after_six_strides() {
        let mut oscillator = Oscillator::new(OscillatorGains::default());
        for ms in 0..16_000 {
            let strides = f64::from(ms) * 1e-3 / curves::STRIDE_MEAN_S;
            let hip_deg = curves::angle_rad(Joint::Hip, strides).value.to_degrees();
            let estimate = oscillator.tick(hip_deg, curves::vertical_load_bw(strides), 1e-3);
            if strides > 6.0 {
                let error = wrapped(estimate.phase - strides);
                assert!(error.abs() < 0.06, "{error} at stride {strides}");
            }
        }
    }
}
