//! A set of numbers from 1, one bit each.

/// The set. Its memory grows with the largest number.
#[derive(Clone, Debug, Default)]
pub struct Numbers(Vec<u64>);

impl Numbers {
    /// Inserts a number. Returns whether it was absent.
    ///
    /// # Panics
    /// If the number is beyond the available memory.
    pub fn insert(&mut self, number: u64) -> bool {
        let (word, bit) = (usize::try_from(number / 64).expect("memory ends before"), 1 << (number % 64));
        if self.0.len() <= word {
            self.0.resize(word + 1, 0);
        }
        let is_new = self.0[word] & bit == 0;
        self.0[word] |= bit;
        is_new
    }

    /// Returns whether the number is in the set.
    #[must_use]
    pub fn has(&self, number: u64) -> bool {
        let word = usize::try_from(number / 64).ok().and_then(|word| self.0.get(word));
        word.is_some_and(|word| word & (1 << (number % 64)) != 0)
    }
}
