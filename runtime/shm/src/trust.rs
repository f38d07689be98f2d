//! The choice of the sleeping place: the bell that all peers can write, or words with one writer each. Pure.

use std::time::{Duration, Instant};

use crate::core::sleep::WakePlace;

/// Time for which the bell is avoided after the first lost ring. Each further time it is twice as long.
const FIRST: Duration = Duration::from_secs(10);
/// After this many times it stays the same: 21 minutes.
const DOUBLINGS_MAX: u32 = 7;

/// A thread's record of the bell that its peers have in common.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Trust {
    doubts: u32,
    until: Option<Instant>,
}

impl Trust {
    pub(crate) const fn new() -> Self {
        Self { doubts: 0, until: None }
    }

    /// Returns where to sleep now. The clock is read only if that makes a difference.
    pub(crate) fn wake_place(&self, now: impl FnOnce() -> Instant) -> WakePlace {
        match self.until {
            Some(until) if now() < until => WakePlace::Own,
            Some(_) | None => WakePlace::Bell,
        }
    }

    /// Records that a peer has rung, and the sleeper was not woken.
    pub(crate) fn doubt(&mut self, now: Instant) {
        self.until = Some(now + FIRST * 2_u32.pow(self.doubts));
        self.doubts = (self.doubts + 1).min(DOUBLINGS_MAX);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn bell_that_lost_rings_is_avoided_for_doubling_times() {
        let (mut trust, mut now) = (Trust::new(), Instant::now());
        assert_eq!(trust.wake_place(|| now), WakePlace::Bell);
        for times in [1, 2, 4, 8, 16, 32, 64, 128, 128, 128] {
            trust.doubt(now);
            now += FIRST * times;
            assert_eq!(trust.wake_place(|| now - Duration::from_nanos(1)), WakePlace::Own, "{times}");
            assert_eq!(trust.wake_place(|| now), WakePlace::Bell, "{times}");
        }
    }
}
