//! Numbers that a seed decides: the same seed, the same plan.

use std::time::Duration;

/// A row of numbers: xorshift64*.
#[derive(Clone, Debug)]
pub struct Dice(u64);

impl Dice {
    /// The row of this seed.
    #[must_use]
    pub const fn new(seed: u64) -> Self {
        Self(seed.wrapping_mul(0x9E37_79B9_7F4A_7C15) | 1)
    }

    /// The next number.
    pub const fn roll(&mut self) -> u64 {
        self.0 ^= self.0 >> 12;
        self.0 ^= self.0 << 25;
        self.0 ^= self.0 >> 27;
        self.0.wrapping_mul(0x2545_F491_4F6C_DD1D)
    }

    /// A number below `limit`, which is not zero.
    pub const fn below(&mut self, limit: u32) -> u32 {
        (self.roll() >> 32) as u32 % limit
    }

    /// Whether the one case of `cases` came.
    pub const fn once_in(&mut self, cases: u32) -> bool {
        self.below(cases) == 0
    }

    /// A time below `limit`.
    pub fn time_below(&mut self, limit: Duration) -> Duration {
        limit.mul_f64(f64::from(self.below(1 << 20)) / f64::from(1 << 20))
    }

    /// So many bytes.
    pub fn bytes(&mut self, count: usize) -> Vec<u8> {
        (0..count).map(|_| self.roll() as u8).collect()
    }
}
