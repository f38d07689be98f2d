//! Restart counts over a window, and the jitter of waits.

use std::{collections::VecDeque, time::Duration};

use crate::time::Time;

/// The times of the last restarts: as many as one window may have, and one more.
#[derive(Debug, Default)]
pub(super) struct Window(VecDeque<Time>);

impl Window {
    /// Adds one restart at `now`. Returns whether the window that ends now has more than `max`.
    pub(super) fn add(&mut self, now: Time, max: usize, window: Duration) -> bool {
        self.0.push_back(now);
        while self.0.front().is_some_and(|at| now.since(*at) > window) {
            self.0.pop_front();
        }
        self.0.len() > max
    }

    /// Returns the number of restarts in the window that ends now.
    pub(super) fn count(&self, now: Time, window: Duration) -> usize {
        self.0.iter().filter(|at| now.since(**at) <= window).count()
    }
}

/// A random generator with a seed: equal seeds give equal numbers.
#[derive(Clone, Debug)]
pub(super) struct Chance(fastrand::Rng);

impl Chance {
    pub(super) fn new(seed: u64) -> Self {
        Self(fastrand::Rng::with_seed(seed))
    }

    /// Returns the seed that continues the current sequence.
    pub(super) fn seed(&self) -> u64 {
        self.0.get_seed()
    }

    #[cfg(test)]
    pub(super) fn next(&mut self) -> u64 {
        self.0.u64(..)
    }

    /// Returns `wait`, shortened by a random part of up to a quarter, so that children that failed together
    /// are not restarted together. It is never lengthened, so the policy's maximum wait holds.
    pub(super) fn jitter(&mut self, wait: Duration) -> Duration {
        let shorter_permille = self.0.u32(..=250);
        wait - wait * shorter_permille / 1_000
    }
}
