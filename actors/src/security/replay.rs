//! Which numbers of a sender were taken already: the sliding window of RFC 4303, appendix A.2, over a ring of words as in RFC 6479.
//!
//! One life numbers all its datagrams in one row, to whomever they go. So how far a datagram is behind is not how many overtook it on its way
//! here, but how many its sender made meanwhile for everybody: twice as many in a period as it has members, times the routes to each. With
//! 64 numbers, which are enough for a row of its own, a sender with 40 members lost every datagram that came 0.4 periods later than the next.

/// Words of the ring.
const WORDS: usize = 32;
const BITS: u64 = u64::BITS as u64;

/// Numbers that have been taken: the highest one, and which of the [`SPAN`](Window::SPAN) up to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Window {
    /// The highest number that was taken; 0: none yet.
    highest: u64,
    /// Of number `n`, bit `n % 64` of word `n / 64 % WORDS` is set if it was taken.
    taken: [u64; WORDS],
}

impl Window {
    /// How far behind the highest number one may be that was overtaken on the way. All words but the one that the highest number fills.
    pub(super) const SPAN: u64 = (WORDS as u64 - 1) * BITS;

    /// None up to `number` is taken any more.
    pub(super) fn after(number: u64) -> Self {
        let mut taken = [u64::MAX; WORDS];
        // Those behind it in its own word are still to come.
        taken[Self::word(number)] = u64::MAX >> (BITS - 1 - number % BITS);
        Self { highest: number, taken }
    }

    /// Whether a number was taken that is so far after `made` that it hides the next ones, also if `meanwhile` more were made since that was
    /// said.
    pub(super) const fn is_beyond(&self, made: u64, meanwhile: u64) -> bool {
        self.highest.saturating_sub(made) > Self::SPAN.saturating_add(meanwhile)
    }

    const fn word(number: u64) -> usize {
        (number / BITS % WORDS as u64) as usize
    }

    /// Takes `number`, unless it was taken before or is too far behind to know. Numbers begin with 1.
    pub(super) fn take(&mut self, number: u64) -> bool {
        if number > self.highest {
            // The words between held numbers that are too far behind now.
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

    /// The rule, written down in another way.
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
    fn the_ends_of_the_window_and_of_the_numbers_hold() {
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
    fn of_what_was_made_before_none_counts_and_the_next_one_does() {
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
    fn a_number_is_beyond_what_was_made_if_it_hides_the_next_ones_and_cannot_have_been_made_meanwhile() {
        let mut window = Window::after(0);
        assert!(window.take(Window::SPAN + 101));
        assert!(window.is_beyond(0, 100));
        assert!(!window.is_beyond(0, 101) && !window.is_beyond(1, 100) && !window.is_beyond(0, u64::MAX));
    }

    proptest! {
        #[test]
        fn every_number_is_taken_once_in_any_order(
            numbers in prop::collection::vec(prop_oneof![0..200_u64, 0..5_000_u64, 0..u64::MAX, Just(u64::MAX)], 0..300),
        ) {
            prop_assert_eq!(taken(&numbers), model(&numbers));
        }
    }
}
