//! Replay protection: which numbers of a sender were received.

/// Words of the window.
const WORDS: usize = 32;

/// The received numbers of one sender, as far back as [`SPAN`](Self::SPAN).
///
/// # Examples
///
/// ```
/// use sinew_zenoh_link::ReplayWindow;
///
/// let mut window = ReplayWindow::default();
/// assert!(window.admit(7) && window.admit(5));
/// assert!(!window.admit(7), "it was received before");
/// ```
#[derive(Clone, Debug, Default)]
pub struct ReplayWindow {
    /// One more than the highest number; 0 before the first one.
    next: u64,
    /// One bit for each number, at its remainder.
    seen: [u64; WORDS],
}

impl ReplayWindow {
    /// Numbers below the highest one that can still be received. Classes of different priority overtake each
    /// other by a router's queues, and these hold fewer packets.
    pub const SPAN: u64 = 64 * WORDS as u64;

    /// Records a number. Returns whether it is new. // spec: ZLINK-4.1
    pub fn admit(&mut self, number: u64) -> bool {
        // A sender never makes that many packets.
        let Some(after) = number.checked_add(1) else { return false };
        if after > self.next {
            let first = self.next.max(after.saturating_sub(Self::SPAN));
            (first..after).for_each(|passed| *self.word(passed) &= !bit(passed));
            self.next = after;
        } else if self.next - number > Self::SPAN || *self.word(number) & bit(number) != 0 {
            return false;
        }
        *self.word(number) |= bit(number);
        true
    }

    fn word(&mut self, number: u64) -> &mut u64 {
        let at = usize::try_from(number % Self::SPAN / 64).expect("a remainder below 32");
        &mut self.seen[at]
    }
}

const fn bit(number: u64) -> u64 {
    1 << (number % 64)
}

#[cfg(test)]
mod tests {
    use std::collections::BTreeSet;

    use proptest::prelude::*;

    use super::*;

    #[test]
    fn number_older_than_the_span_is_refused() {
        let mut window = ReplayWindow::default();
        assert!(window.admit(ReplayWindow::SPAN));
        assert!(window.admit(1));
        assert!(!window.admit(0));
        assert!(!window.admit(u64::MAX));
    }

    proptest! {
        #[test]
        fn window_agrees_with_a_set_of_all_numbers(
            numbers in proptest::collection::vec(0_u64..3 * ReplayWindow::SPAN, 0..400),
        ) {
            let (mut window, mut all) = (ReplayWindow::default(), BTreeSet::new());
            for number in numbers {
                let highest = all.last().copied().unwrap_or(0);
                let is_recent = number + ReplayWindow::SPAN > highest;
                prop_assert_eq!(window.admit(number), is_recent && all.insert(number), "{}", number);
            }
        }
    }
}
