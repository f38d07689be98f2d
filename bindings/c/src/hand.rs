//! What a program in C has in hand: values behind numbers, so that one that was given back is refused, not followed.

use std::sync::atomic::{AtomicU64, Ordering};

/// Bits of a token that say its place.
const PLACE_BITS: u32 = 16;
/// Values that were ever taken into any hand of this process: what one endpoint has in hand is nobody else's.
static TAKEN: AtomicU64 = AtomicU64::new(1);

/// Values in the hand of a program, each behind a token that no other value of this process ever had.
#[derive(Debug)]
pub(crate) struct Hand<T> {
    /// The token of each place's value, and the value.
    places: Vec<(u64, Option<T>)>,
    free: Vec<usize>,
    limit: usize,
}

impl<T> Hand<T> {
    /// A hand for at most `limit` values, which is below 65,536.
    pub(crate) const fn new(limit: usize) -> Self {
        assert!(limit < 1 << PLACE_BITS, "a place has so many bits");
        Self { places: Vec::new(), free: Vec::new(), limit }
    }

    pub(crate) const fn is_full(&self) -> bool {
        self.free.is_empty() && self.places.len() == self.limit
    }

    /// Takes a value into the hand; hands it back if the hand is full. Memory is asked for only when it is fuller than ever.
    pub(crate) fn take(&mut self, value: T) -> Result<u64, T> {
        let place = match self.free.pop() {
            Some(place) => place,
            None if self.is_full() => return Err(value),
            None => {
                self.places.push((0, None));
                self.places.len() - 1
            }
        };
        let token = TAKEN.fetch_add(1, Ordering::Relaxed) << PLACE_BITS | place as u64;
        self.places[place] = (token, Some(value));
        Ok(token)
    }

    pub(crate) fn get_mut(&mut self, token: u64) -> Option<&mut T> {
        let (held, value) = self.places.get_mut(place_of(token))?;
        if *held == token { value.as_mut() } else { None }
    }

    /// Gives a value out of the hand.
    pub(crate) fn give(&mut self, token: u64) -> Option<T> {
        let place = place_of(token);
        let (held, value) = self.places.get_mut(place)?;
        if *held != token {
            return None;
        }
        let value = value.take()?;
        self.free.push(place);
        Some(value)
    }

    /// Gives all out.
    pub(crate) fn empty(&mut self) -> impl Iterator<Item = T> {
        self.free.clear();
        std::mem::take(&mut self.places).into_iter().filter_map(|(_, value)| value)
    }
}

const fn place_of(token: u64) -> usize {
    (token & ((1 << PLACE_BITS) - 1)) as usize
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn a_token_is_good_once_and_only_for_its_value() {
        let mut hand = Hand::new(2);
        let first = hand.take('a').unwrap();
        assert_eq!(hand.get_mut(first), Some(&mut 'a'));
        assert_eq!(hand.give(first), Some('a'));
        let second = hand.take('b').unwrap();
        assert_ne!(first, second);
        for wrong in [first, 0, 1, u64::MAX, second + 1] {
            assert_eq!(hand.get_mut(wrong), None, "{wrong}");
            assert_eq!(hand.give(wrong), None, "{wrong}");
        }
        assert_eq!(hand.give(second), Some('b'));
        assert_eq!(hand.give(second), None);
    }

    #[test]
    fn a_token_of_another_hand_is_good_for_nothing() {
        let (mut one, mut other) = (Hand::new(2), Hand::new(1));
        let (here, there) = (one.take('a').unwrap(), other.take('b').unwrap());
        assert_eq!((one.give(there), other.give(here)), (None, None));
        assert_eq!((one.give(here), other.give(there)), (Some('a'), Some('b')));
    }

    #[test]
    fn a_hand_has_a_limit_and_is_emptied_whole() {
        let mut hand = Hand::new(2);
        hand.take(1).unwrap();
        hand.take(2).unwrap();
        assert!(hand.is_full());
        assert_eq!(hand.take(3), Err(3));
        assert_eq!(hand.empty().collect::<Vec<_>>(), [1, 2]);
        assert!(!hand.is_full());
    }
}
