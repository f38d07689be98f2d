//! The baseline of the literature: time since heel strike over the mean of the last three strides.

use super::PhaseEstimate;
use super::heel_strike::HeelStrikeDetector;

const STRIDES_MEANED: usize = 3;
const STRIDE_LONGEST_S: f64 = 2.0;

/// Phase by stopwatch. Needs heel strikes, has no information between them, and stops at 1 when a stride is
/// late.
#[derive(Debug, Clone)]
pub struct StrideClock {
    durations_s: [f64; STRIDES_MEANED],
    counted: usize,
    strikes: HeelStrikeDetector,
    phase: f64,
}

impl StrideClock {
    /// A clock that assumes strides of `stride_s` until it has measured some.
    #[must_use]
    pub fn new(stride_s: f64) -> Self {
        Self {
            durations_s: [stride_s; STRIDES_MEANED],
            counted: 0,
            strikes: HeelStrikeDetector::default(),
            phase: 0.0,
        }
    }

    /// Takes the vertical load (body weights), `dt_s` after the last one.
    pub fn tick(&mut self, load_bw: f64, dt_s: f64) -> PhaseEstimate {
        let strike = self.strikes.tick(load_bw, dt_s);
        let interval_s = strike.and_then(|s| s.interval_s).filter(|s| *s < STRIDE_LONGEST_S);
        let strike_error = interval_s.map(|s| 1.0 - s / self.mean_s());
        if let Some(interval_s) = interval_s {
            self.durations_s[self.counted % STRIDES_MEANED] = interval_s;
            self.counted += 1;
        }
        let mean_s = self.mean_s();
        self.phase = self.strikes.since_strike_s().map_or(0.0, |s| (s / mean_s).min(1.0));
        PhaseEstimate { phase: self.phase.rem_euclid(1.0), rate_hz: 1.0 / mean_s, strike_error }
    }

    /// Advances time without inputs.
    pub fn coast(&mut self, dt_s: f64) {
        self.strikes.coast(dt_s);
    }

    fn mean_s(&self) -> f64 {
        self.durations_s.iter().sum::<f64>() / STRIDES_MEANED as f64
    }
}

#[cfg(test)]
mod tests {
    use super::*;
    use crate::gait::curves;
    use crate::phase::wrapped;

    #[test]
    fn steady_strides_are_followed_within_one_per_cent() {
        let mut clock = StrideClock::new(1.1);
        for ms in 0..12_000 {
            let strides = f64::from(ms) * 1e-3 / curves::STRIDE_MEAN_S;
            let estimate = clock.tick(curves::vertical_load_bw(strides), 1e-3);
            if strides > 5.0 {
                assert!(wrapped(estimate.phase - strides).abs() < 0.01);
            }
        }
    }
}
