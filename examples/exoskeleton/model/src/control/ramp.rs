//! Ramps: the torque's rate limiter and the gain with which assistance returns.

/// Limits how fast a torque changes; its output never steps.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct RateLimiter {
    rate_nm_s: f64,
    torque_nm: f64,
}

impl RateLimiter {
    /// A limiter of `rate_nm_s` (Nm/s) that starts from zero torque.
    #[must_use]
    pub const fn new(rate_nm_s: f64) -> Self {
        Self { rate_nm_s, torque_nm: 0.0 }
    }

    /// Continues from the torque that the device already applies, Nm.
    pub const fn start_from(&mut self, torque_nm: f64) {
        self.torque_nm = torque_nm;
    }

    /// Moves toward `target_nm` for `dt_s` and returns the torque reached, Nm.
    pub fn toward(&mut self, target_nm: f64, dt_s: f64) -> f64 {
        let step_nm = self.rate_nm_s * dt_s;
        self.torque_nm += (target_nm - self.torque_nm).clamp(-step_nm, step_nm);
        self.torque_nm
    }

    /// The torque last returned, Nm.
    #[must_use]
    pub const fn torque_nm(&self) -> f64 {
        self.torque_nm
    }
}

/// Time in which the gain falls from 1 to 0 while damping, seconds: after a hiccup it does not rise from zero
/// again.
const FALL_S: f64 = 0.1;

/// Gain 0..1 that rises in a given time while assisting, falls fast while damping, and drops to 0 otherwise.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct AssistRamp {
    rise_s: f64,
    gain: f64,
}

impl AssistRamp {
    /// A ramp that needs `rise_s` seconds from 0 to 1; 0 is no ramp.
    #[must_use]
    pub const fn new(rise_s: f64) -> Self {
        Self { rise_s, gain: 0.0 }
    }

    /// Sets the time of a rise from 0 to 1, seconds.
    pub const fn rise_in(&mut self, rise_s: f64) {
        self.rise_s = rise_s;
    }

    /// Rises for `dt_s` and returns the gain.
    pub fn rise(&mut self, dt_s: f64) -> f64 {
        self.gain = if self.rise_s > 0.0 { (self.gain + dt_s / self.rise_s).min(1.0) } else { 1.0 };
        self.gain
    }

    /// Falls for `dt_s`. This does not change the torque meanwhile; it sets the level from which assistance
    /// rises again.
    pub fn fall(&mut self, dt_s: f64) {
        self.gain = (self.gain - dt_s / FALL_S).max(0.0);
    }

    /// Returns to zero; the rate limiter behind it prevents a step of the torque.
    pub const fn drop_to_zero(&mut self) {
        self.gain = 0.0;
    }

    /// The gain, 0..1.
    #[must_use]
    pub const fn gain(&self) -> f64 {
        self.gain
    }
}
