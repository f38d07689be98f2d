//! Heel strikes from the vertical load under the foot.

/// Load at which the foot counts as on the ground, body weights.
pub const CONTACT_BW: f64 = 0.05;
const STRIKE_GAP_MIN_S: f64 = 0.6;

/// Finds the instants at which the load rises through [`CONTACT_BW`]; two of them lie more than 0.6 s apart.
#[derive(Debug, Clone, Default)]
pub struct HeelStrikeDetector {
    load_before_bw: Option<f64>,
    since_strike_s: Option<f64>,
}

/// A heel strike.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct HeelStrike {
    /// Time since the one before, seconds; `None` for the first.
    pub interval_s: Option<f64>,
}

impl HeelStrikeDetector {
    /// Takes the load of this tick, `dt_s` after the last one.
    pub fn tick(&mut self, load_bw: f64, dt_s: f64) -> Option<HeelStrike> {
        let before = self.load_before_bw.replace(load_bw).unwrap_or(load_bw);
        self.since_strike_s = self.since_strike_s.map(|s| s + dt_s);
        let settled = self.since_strike_s.is_none_or(|s| s > STRIKE_GAP_MIN_S);
        if before < CONTACT_BW && load_bw >= CONTACT_BW && settled {
            let interval_s = self.since_strike_s.replace(0.0);
            return Some(HeelStrike { interval_s });
        }
        None
    }

    /// Advances time without inputs.
    pub fn coast(&mut self, dt_s: f64) {
        self.since_strike_s = self.since_strike_s.map(|s| s + dt_s);
    }

    /// Time since the last heel strike, seconds; `None` before the first.
    #[must_use]
    pub const fn since_strike_s(&self) -> Option<f64> {
        self.since_strike_s
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn chatter_right_after_contact_is_one_strike() {
        let mut detector = HeelStrikeDetector::default();
        let strikes =
            [0.0, 0.1, 0.0, 0.2, 0.04, 0.3].iter().filter(|l| detector.tick(**l, 0.01).is_some()).count();
        assert_eq!(strikes, 1);
    }

    #[test]
    fn foot_that_stood_from_the_start_is_no_strike() {
        let mut detector = HeelStrikeDetector::default();
        assert!((0..100).all(|_| detector.tick(0.5, 0.001).is_none()));
    }
}
