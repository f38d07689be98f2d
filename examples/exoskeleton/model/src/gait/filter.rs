//! Second-order Butterworth low-pass, run forward and backward so that it shifts nothing in time.

use std::f64::consts::{PI, SQRT_2};

/// Samples mirrored at each end before filtering, as SciPy's `filtfilt` does for a second-order filter.
const MIRRORED: usize = 9;

/// A second-order digital low-pass.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct LowPass {
    b: [f64; 3],
    a: [f64; 2],
}

impl LowPass {
    /// Butterworth with `cutoff_hz` (-3 dB in one direction) for samples at `rate_hz`.
    /// `None` unless 0 < cutoff < rate / 2.
    #[must_use]
    pub fn butterworth(cutoff_hz: f64, rate_hz: f64) -> Option<Self> {
        if !(cutoff_hz > 0.0 && cutoff_hz < rate_hz / 2.0) {
            return None;
        }
        let k = (PI * cutoff_hz / rate_hz).tan();
        let norm = 1.0 / (1.0 + SQRT_2 * k + k * k);
        let b0 = k * k * norm;
        Some(Self {
            b: [b0, 2.0 * b0, b0],
            a: [2.0 * (k * k - 1.0) * norm, (1.0 - SQRT_2 * k + k * k) * norm],
        })
    }

    /// Filters forward, then backward. The same length comes back; an input shorter than 10 samples comes back
    /// as it was, because there is nothing to mirror.
    #[must_use]
    pub fn zero_phase(&self, samples: &[f64]) -> Vec<f64> {
        let n = samples.len();
        if n <= MIRRORED {
            return samples.to_vec();
        }
        let (first, last) = (samples[0], samples[n - 1]);
        let mut extended: Vec<f64> = (1..=MIRRORED).rev().map(|i| 2.0 * first - samples[i]).collect();
        extended.extend_from_slice(samples);
        extended.extend((1..=MIRRORED).map(|i| 2.0 * last - samples[n - 1 - i]));
        self.run(&mut extended);
        extended.reverse();
        self.run(&mut extended);
        extended.reverse();
        extended[MIRRORED..MIRRORED + n].to_vec()
    }

    /// One pass in place, started as if the first sample had been there forever.
    fn run(&self, samples: &mut [f64]) {
        let Some(&start) = samples.first() else { return };
        let mut z0 = (1.0 - self.b[0]) * start;
        let mut z1 = (self.b[2] - self.a[1]) * start;
        for sample in samples {
            let x = *sample;
            let y = self.b[0] * x + z0;
            z0 = self.b[1] * x - self.a[0] * y + z1;
            z1 = self.b[2] * x - self.a[1] * y;
            *sample = y;
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn constant_passes_unchanged() {
        let filter = LowPass::butterworth(6.0, 100.0).unwrap();
        assert!(filter.zero_phase(&[3.5; 50]).iter().all(|y| (y - 3.5).abs() < 1e-12));
    }

    #[test]
    fn slow_wave_is_kept_and_fast_wave_removed() {
        let filter = LowPass::butterworth(6.0, 100.0).unwrap();
        let wave =
            |hz: f64| (0..400).map(|i| (2.0 * PI * hz * f64::from(i) / 100.0).sin()).collect::<Vec<_>>();
        let slow = wave(0.75);
        let kept = filter.zero_phase(&slow);
        assert!((50..350).all(|i| (kept[i] - slow[i]).abs() < 1e-3));
        let removed = filter.zero_phase(&wave(30.0));
        assert!((50..350).all(|i| removed[i].abs() < 5e-3));
    }

    #[test]
    fn cutoff_beyond_half_the_rate_is_rejected() {
        assert!(LowPass::butterworth(50.0, 100.0).is_none());
        assert!(LowPass::butterworth(f64::NAN, 100.0).is_none());
    }
}
