//! The ages of messages: of the oldest one that waits, and of those that were handled, as a histogram.

use std::time::Duration;

use super::Mailbox;
use crate::{lock, outcome::Outcome};

/// The upper bounds of the buckets of [`MessageAges`], in microseconds. They are powers of two, so that a bucket is
/// found without a search. The last bucket has none.
pub const AGE_BOUNDS_US: [u64; 17] = [
    16, 32, 64, 128, 256, 512, 1_024, 2_048, 4_096, 8_192, 16_384, 32_768, 65_536, 131_072, 262_144, 524_288,
    1_048_576,
];

/// The number of buckets of [`MessageAges`].
pub const AGE_BUCKETS: usize = AGE_BOUNDS_US.len() + 1;

/// The number of bits of the ages below the first bound, in microseconds.
const FIRST_BITS: u32 = 4;

/// The ages of delivered messages when their handlers were called, as a histogram. Events of layers, retained values
/// and messages of unknown age are not counted.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub struct MessageAges {
    /// The number of messages in each bucket. An age is counted in the first bucket with a bound that is not below it.
    pub counts: [u64; AGE_BUCKETS],
    /// The sum of all ages in nanoseconds.
    pub sum_ns: u64,
}

impl MessageAges {
    /// Counts a message with its outcome.
    #[inline]
    pub(super) fn count(&mut self, outcome: Outcome, age_ns: Option<u64>) {
        let (Outcome::Delivered, Some(age_ns)) = (outcome, age_ns) else { return };
        // An age of exactly a bound belongs below it.
        let micros = age_ns.saturating_sub(1) / 1_000;
        let bits = u64::BITS - micros.leading_zeros();
        let bucket = (bits.saturating_sub(FIRST_BITS) as usize).min(AGE_BUCKETS - 1);
        self.counts[bucket] += 1;
        self.sum_ns = self.sum_ns.saturating_add(age_ns);
    }
}

impl Mailbox {
    /// Returns the age of the oldest queued message; `None`: none is queued, or its age is unknown.
    #[must_use]
    pub fn oldest(&self) -> Option<Duration> {
        let now = self.clock.now();
        lock(&self.shared).queue.oldest(now)
    }

    /// Returns the ages of the messages that the actor has handled in all its incarnations. Those of an actor in
    /// another process are unknown.
    #[must_use]
    pub fn ages(&self) -> MessageAges {
        lock(&self.shared).ages
    }
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    fn bucket(age_ns: u64) -> Option<usize> {
        let mut ages = MessageAges::default();
        ages.count(Outcome::Delivered, Some(age_ns));
        assert_eq!((ages.counts.iter().sum::<u64>(), ages.sum_ns), (1, age_ns));
        ages.counts.iter().position(|count| *count == 1)
    }

    proptest! {
        #[test]
        fn age_is_in_the_first_bucket_that_holds_it(age_ns in prop_oneof![any::<u64>(), 0..2_000_000_000_u64]) {
            let first = AGE_BOUNDS_US.iter().position(|bound| age_ns <= bound * 1_000);
            prop_assert_eq!(bucket(age_ns), Some(first.unwrap_or(AGE_BUCKETS - 1)));
        }
    }

    #[test]
    fn bound_belongs_to_its_bucket() {
        for (place, bound) in AGE_BOUNDS_US.iter().enumerate() {
            let bound_ns = bound * 1_000;
            assert_eq!((bucket(bound_ns), bucket(bound_ns + 1)), (Some(place), Some(place + 1)));
        }
    }

    #[test]
    fn unknown_ages_and_other_outcomes_are_not_counted() {
        let mut ages = MessageAges::default();
        ages.count(Outcome::Delivered, None);
        ages.count(Outcome::Expired, Some(7));
        assert_eq!(ages, MessageAges::default());
    }
}
