//! Deterministic random numbers: the same seed gives the same sequence.

use std::time::Duration;

/// A sequence of random numbers.
#[derive(Clone, Debug)]
pub struct SeededRandom(fastrand::Rng);

impl SeededRandom {
    /// The sequence of this seed.
    #[must_use]
    pub fn new(seed: u64) -> Self {
        Self(fastrand::Rng::with_seed(seed))
    }

    /// The next number.
    pub fn number(&mut self) -> u64 {
        self.0.u64(..)
    }

    /// A number below `limit`, which is not zero.
    pub fn below(&mut self, limit: u32) -> u32 {
        self.0.u32(..limit)
    }

    /// Returns `true` with probability 1/`cases`.
    pub fn once_in(&mut self, cases: u32) -> bool {
        self.below(cases) == 0
    }

    /// A time below `limit`.
    pub fn time_below(&mut self, limit: Duration) -> Duration {
        limit.mul_f64(f64::from(self.below(1 << 20)) / f64::from(1 << 20))
    }

    /// A vector of random bytes.
    pub fn bytes(&mut self, count: usize) -> Vec<u8> {
        (0..count).map(|_| self.number() as u8).collect()
    }
}
