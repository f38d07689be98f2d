//! The anti-replay window: the sliding window of RFC 4303, appendix A.2, over a ring of words as in RFC 6479.
//!
//! An incarnation numbers all its datagrams in one sequence, for all destinations. The distance of a late
//! datagram is therefore not the number of datagrams that overtook it on this path. It is the number that the
//! sender made meanwhile for all members: per period twice its member count, times the routes to each. With
//! 64 numbers, enough for a sequence per destination, a sender with 40 members lost every datagram that
//! arrived 0.4 periods after the next.

/// Number of words in the ring.
const WORDS: usize = 32;
const BITS: u64 = u64::BITS as u64;

/// The accepted numbers: the highest one, and a bit for each of the [`SPAN`](Window::SPAN) numbers up to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Window {
    /// Highest accepted number; 0: none yet.
    highest: u64,
    /// For number `n`, bit `n % 64` of word `n / 64 % WORDS` is set if it was accepted.
    taken: [u64; WORDS],
}

impl Window {
    /// Maximum distance of a late number from the highest one: all words except the one that the highest number fills.
    pub(super) const SPAN: u64 = (WORDS as u64 - 1) * BITS;

    /// Returns a window that accepts no number up to `number`.
    pub(super) fn after(number: u64) -> Self {
        let mut taken = [u64::MAX; WORDS];
        // The higher numbers in the same word are still acceptable.
        taken[Self::word(number)] = u64::MAX >> (BITS - 1 - number % BITS);
        Self { highest: number, taken }
    }

    /// Returns whether the highest accepted number is so far after `made` that it hides the next ones.
    /// `meanwhile` is the number of datagrams that may have been made since `made` was reported.
    pub(super) const fn is_beyond(&self, made: u64, meanwhile: u64) -> bool {
        self.highest.saturating_sub(made) > Self::SPAN.saturating_add(meanwhile)
    }

    const fn word(number: u64) -> usize {
        (number / BITS % WORDS as u64) as usize
    }

    /// Accepts `number`, unless it was accepted before or is too old to know. Numbers start at 1.
    pub(super) fn take(&mut self, number: u64) -> bool {
        if number > self.highest {
            // The words in between held numbers that are now outside the window.
            let further = (number / BITS - self.highest / BITS).min(WORDS as u64);
            for step in 0..further {
                self.taken[Self::word(number - step * BITS)] = 0;
            }
            self.highest = number;
        } else if number == 0 || self.highest - number >= Self::SPAN {
            return false;
        }
        let bit = 1 << (number % BITS);
        let taken = &mut self.taken[Self::word(number)];
        let is_new = *taken & bit == 0;
        *taken |= bit;
        is_new
    }
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use proptest::prelude::*;

    use super::*;

    /// The same rule in another form.
    fn model(numbers: &[u64]) -> Vec<bool> {
        let (mut seen, mut highest) = (BTreeSet::new(), 0_u64);
        let take = |number: &u64| {
            let is_near = *number > 0 && (*number > highest || highest - *number < Window::SPAN);
            let is_taken = is_near && seen.insert(*number);
            highest = highest.max(if is_taken { *number } else { 0 });
            is_taken
        };
        numbers.iter().map(take).collect()
    }

    fn taken(numbers: &[u64]) -> Vec<bool> {
        let mut window = Window::after(0);
        numbers.iter().map(|number| window.take(*number)).collect()
    }

    #[test]
    fn window_works_at_its_bounds() {
        const SPAN: u64 = Window::SPAN;
        assert_eq!(taken(&[SPAN, 1, 1, SPAN + 1, 1, 2, 0]), [true, true, false, true, false, true, false]);
        assert_eq!(
            taken(&[1, u64::MAX, u64::MAX, u64::MAX - (SPAN - 1), u64::MAX - SPAN]),
            [true, true, false, true, false]
        );
        assert_eq!(taken(&[1, 1 + SPAN, 1]), [true, true, false], "a whole window further");
        assert_eq!(taken(&[5, 5 + 64 * WORDS as u64, 5]), [true, true, false], "a whole ring further");
        assert_eq!(taken(&[1, 1 + (1 << 32), 1 + (1 << 32)]), [true, true, false]);
    }

    #[test]
    fn earlier_numbers_are_rejected_and_next_is_accepted() {
        for made in [0, 1, 62, 63, 64, 65, 2_047, 2_048, 1 << 40] {
            let mut window = Window::after(made);
            assert!(
                (made.saturating_sub(Window::SPAN + 3)..=made).all(|number| !window.take(number)),
                "{made}"
            );
            assert!((made + 1..made + 200).all(|number| window.take(number)), "{made}");
        }
    }

    #[test]
    fn impossible_number_that_hides_next_ones_is_beyond() {
        let mut window = Window::after(0);
        assert!(window.take(Window::SPAN + 101));
        assert!(window.is_beyond(0, 100));
        assert!(!window.is_beyond(0, 101) && !window.is_beyond(1, 100) && !window.is_beyond(0, u64::MAX));
    }

    proptest! {
        #[test]
        fn every_number_is_accepted_once_in_any_order(
            numbers in prop::collection::vec(prop_oneof![0..200_u64, 0..5_000_u64, 0..u64::MAX, Just(u64::MAX)], 0..300),
        ) {
            prop_assert_eq!(taken(&numbers), model(&numbers));
        }
    }
}
