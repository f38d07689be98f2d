//! Whether a thread sleeps at the bell that all its peers can write, or at words of which each has one writer. Pure.

use std::time::{Duration, Instant};

use crate::core::sleep::Ear;

/// How long the bell is not slept at when a ring was robbed for the first time. Each further time it is twice as long.
const FIRST: Duration = Duration::from_secs(10);
/// After so many times it stays as long: 21 minutes.
const DOUBLINGS_MAX: u32 = 7;

/// What a thread has learned about the bell that its peers have in common.
#[derive(Clone, Copy, Debug)]
pub(crate) struct Trust {
    doubts: u32,
    until: Option<Instant>,
}

impl Trust {
    pub(crate) const fn new() -> Self {
        Self { doubts: 0, until: None }
    }

    /// Where to sleep now. The clock is read where that makes a difference.
    pub(crate) fn ear(&self, now: impl FnOnce() -> Instant) -> Ear {
        match self.until {
            Some(until) if now() < until => Ear::Own,
            Some(_) | None => Ear::Bell,
        }
    }

    /// A peer has rung, and the sleeper was not woken.
    pub(crate) fn doubt(&mut self, now: Instant) {
        self.until = Some(now + FIRST * 2_u32.pow(self.doubts));
        self.doubts = (self.doubts + 1).min(DOUBLINGS_MAX);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_bell_that_was_robbed_is_not_slept_at_for_a_while_that_doubles_up_to_a_bound() {
        let (mut trust, mut now) = (Trust::new(), Instant::now());
        assert_eq!(trust.ear(|| now), Ear::Bell);
        for times in [1, 2, 4, 8, 16, 32, 64, 128, 128, 128] {
            trust.doubt(now);
            now += FIRST * times;
            assert_eq!(trust.ear(|| now - Duration::from_nanos(1)), Ear::Own, "{times}");
            assert_eq!(trust.ear(|| now), Ear::Bell, "{times}");
        }
    }
}
