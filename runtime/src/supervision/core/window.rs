//! How often something happened of late, and how far to wait with doing it again.

use std::{collections::VecDeque, time::Duration};

use crate::time::Time;

/// The times of the last restarts: as many as may be in one window, and one more.
#[derive(Debug, Default)]
pub(super) struct Window(VecDeque<Time>);

impl Window {
    /// Counts one at `now`. Whether there are more than `max` in the window that ends now.
    pub(super) fn add(&mut self, now: Time, max: usize, window: Duration) -> bool {
        self.0.push_back(now);
        while self.0.front().is_some_and(|at| now.since(*at) > window) {
            self.0.pop_front();
        }
        self.0.len() > max
    }

    /// How many there are in the window that ends now.
    pub(super) fn count(&self, now: Time, window: Duration) -> usize {
        self.0.iter().filter(|at| now.since(**at) <= window).count()
    }
}

/// Chance from a seed: the same seed gives the same numbers.
#[derive(Clone, Debug)]
pub(super) struct Chance(fastrand::Rng);

impl Chance {
    pub(super) fn new(seed: u64) -> Self {
        Self(fastrand::Rng::with_seed(seed))
    }

    /// From which the same numbers come as from here on.
    pub(super) fn seed(&self) -> u64 {
        self.0.get_seed()
    }

    #[cfg(test)]
    pub(super) fn next(&mut self) -> u64 {
        self.0.u64(..)
    }

    /// `wait`, shortened by up to a quarter of it: children that failed together do not come back together. Never
    /// lengthened, so that the longest wait stays what the policy says.
    pub(super) fn jitter(&mut self, wait: Duration) -> Duration {
        let shorter_permille = self.0.u32(..=250);
        wait - wait * shorter_permille / 1_000
    }
}
