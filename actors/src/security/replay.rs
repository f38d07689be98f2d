//! Which numbers of a sender were taken already: the sliding window of RFC 4303, appendix A.2.

/// Numbers that have been taken: the highest one, and which of the [`SPAN`](Window::SPAN) up to it.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) struct Window {
    /// The highest number that was taken; 0: none yet.
    highest: u64,
    /// Bit `n` is set if `highest - n` was taken.
    taken: u64,
}

impl Window {
    /// How far behind the highest number one may be that overtook on the way.
    pub(super) const SPAN: u64 = u64::BITS as u64;

    /// None up to `number` is taken any more.
    pub(super) const fn after(number: u64) -> Self {
        Self { highest: number, taken: u64::MAX }
    }

    /// Takes `number`, unless it was taken before or is too far behind to know. Numbers begin with 1.
    pub(super) fn take(&mut self, number: u64) -> bool {
        if number > self.highest {
            let ahead = number - self.highest;
            let shifted = u32::try_from(ahead).ok().and_then(|ahead| self.taken.checked_shl(ahead));
            self.taken = shifted.unwrap_or_default() | 1;
            self.highest = number;
            return true;
        }
        let behind = self.highest - number;
        if number == 0 || behind >= Self::SPAN {
            return false;
        }
        let bit = 1 << behind;
        let is_new = self.taken & bit == 0;
        self.taken |= bit;
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
            let is_near = *number > 0 && (*number > highest || highest - *number < 64);
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
        assert_eq!(taken(&[64, 1, 1, 65, 1, 2, 0]), [true, true, false, true, false, true, false]);
        assert_eq!(
            taken(&[1, u64::MAX, u64::MAX, u64::MAX - 63, u64::MAX - 64]),
            [true, true, false, true, false]
        );
        assert_eq!(taken(&[1, 65, 1]), [true, true, false], "a whole window further");
        assert_eq!(taken(&[1, 1 + (1 << 32), 1 + (1 << 32)]), [true, true, false], "a shift of 0 in 32 bits");
    }

    proptest! {
        #[test]
        fn every_number_is_taken_once_in_any_order(
            numbers in prop::collection::vec(prop_oneof![0..200_u64, 0..u64::MAX, Just(u64::MAX)], 0..300),
        ) {
            prop_assert_eq!(taken(&numbers), model(&numbers));
        }
    }
}
