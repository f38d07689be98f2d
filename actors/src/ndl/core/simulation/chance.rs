//! Chance from a seed (splitmix64).

use std::time::Duration;

/// The same seed gives the same numbers.
#[derive(Debug)]
pub(in crate::ndl::core) struct Chance(u64);

impl Chance {
    pub(in crate::ndl::core) const fn new(seed: u64) -> Self {
        Self(seed)
    }

    pub(in crate::ndl::core) const fn draw(&mut self) -> u64 {
        self.0 = self.0.wrapping_add(0x9e37_79b9_7f4a_7c15);
        let mut mixed = self.0;
        mixed = (mixed ^ (mixed >> 30)).wrapping_mul(0xbf58_476d_1ce4_e5b9);
        mixed = (mixed ^ (mixed >> 27)).wrapping_mul(0x94d0_49bb_1331_11eb);
        mixed ^ (mixed >> 31)
    }

    /// A number from 0 to `end`, without it; `end` is not 0.
    pub(in crate::ndl::core) const fn below(&mut self, end: u64) -> u64 {
        self.draw() % end
    }

    pub(in crate::ndl::core) fn index(&mut self, end: usize) -> usize {
        usize::try_from(self.below(end as u64)).expect("below a usize")
    }

    pub(in crate::ndl::core) const fn happens(&mut self, per_mille: u64) -> bool {
        self.below(1_000) < per_mille
    }

    pub(in crate::ndl::core) fn of<T: Copy>(&mut self, choices: &[T]) -> T {
        choices[self.index(choices.len())]
    }

    /// A duration from `least` to `most`.
    pub(in crate::ndl::core) fn between(&mut self, least: Duration, most: Duration) -> Duration {
        let width = u64::try_from(most.saturating_sub(least).as_nanos()).expect("it is short");
        least + Duration::from_nanos(self.below(width + 1))
    }
}
