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

/// Chance from a seed (splitmix64): the same seed gives the same numbers.
#[derive(Clone, Copy, Debug)]
pub(super) struct Chance(pub(super) u64);

impl Chance {
    pub(super) const fn next(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut mixed = self.0;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        mixed ^ (mixed >> 31)
    }

    /// `wait`, shortened by up to a quarter of it: children that failed together do not come back together. Never
    /// lengthened, so that the longest wait stays what the policy says.
    pub(super) fn jitter(&mut self, wait: Duration) -> Duration {
        let shorter_permille = u32::try_from(self.next() % 251).expect("a remainder below 251 fits");
        wait - wait * shorter_permille / 1_000
    }
}
