//! The position of the leg in its stride: estimators of the gait phase from hip angle and foot load.

pub mod hand_over;
pub mod heel_strike;
pub mod oscillator;
pub mod stride_clock;

/// The result of an estimator after a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct PhaseEstimate {
    /// Estimated phase, cycles 0..1.
    pub phase: f64,
    /// Estimated phase rate, cycles per second.
    pub rate_hz: f64,
    /// At a heel strike: the error of the estimate at that moment, cycles -0.5..0.5. `None` between heel
    /// strikes and at the first one, which only sets the zero.
    pub strike_error: Option<f64>,
}

/// An angle or phase difference wrapped to -0.5..0.5 cycles.
#[must_use]
pub fn wrapped(cycles: f64) -> f64 {
    (cycles + 0.5).rem_euclid(1.0) - 0.5
}
