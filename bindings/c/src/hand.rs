//! What a program in C has in hand: values behind numbers, so that one that was given back is refused, not followed.

/// Values in the hand of a program, each behind a token that no other value ever had.
#[derive(Debug)]
pub(crate) struct Hand<T> {
    /// The token of each place's value, and the value.
    places: Vec<(u64, Option<T>)>,
    free: Vec<usize>,
    limit: usize,
    taken: u64,
}

impl<T> Hand<T> {
    /// A hand for at most `limit` values.
    pub(crate) const fn new(limit: usize) -> Self {
        Self { places: Vec::new(), free: Vec::new(), limit, taken: 0 }
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
        self.taken += 1;
        let token = self.taken * self.limit as u64 + place as u64;
        self.places[place] = (token, Some(value));
        Ok(token)
    }

    pub(crate) fn get_mut(&mut self, token: u64) -> Option<&mut T> {
        let place = self.place_of(token);
        let (held, value) = self.places.get_mut(place)?;
        if *held == token { value.as_mut() } else { None }
    }

    /// Gives a value out of the hand.
    pub(crate) fn give(&mut self, token: u64) -> Option<T> {
        let place = self.place_of(token);
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

    const fn place_of(&self, token: u64) -> usize {
        (token % self.limit as u64) as usize
    }
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
