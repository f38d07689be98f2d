//! A set of numbers from 1, one bit each.

/// The set. Its memory grows with the largest number.
#[derive(Clone, Debug, Default)]
pub(crate) struct Numbers(Vec<u64>);

impl Numbers {
    /// Adds one; whether it was not there.
    ///
    /// # Panics
    /// If the number is beyond what a memory can hold.
    pub(crate) fn insert(&mut self, number: u64) -> bool {
        let (word, bit) = (usize::try_from(number / 64).expect("memory ends before"), 1 << (number % 64));
        if self.0.len() <= word {
            self.0.resize(word + 1, 0);
        }
        let is_new = self.0[word] & bit == 0;
        self.0[word] |= bit;
        is_new
    }

    /// Whether it is there.
    pub(crate) fn has(&self, number: u64) -> bool {
        let word = usize::try_from(number / 64).ok().and_then(|word| self.0.get(word));
        word.is_some_and(|word| word & (1 << (number % 64)) != 0)
    }
}
