//! The numbers of a channel, in order.
//!
//! Two threads that send on one channel can write their records in another order than that of their numbers. So a
//! number is missing only when the records after it have waited for it.

use std::collections::BTreeMap;

/// A number is missing once there is a record with a number that is higher by this.
pub const WINDOW: u64 = 64;

/// The next step of a channel.
#[derive(Debug, PartialEq, Eq)]
pub(crate) enum Step<T> {
    /// So many numbers are missing.
    Missing(u64),
    /// The record with the next number.
    Next(T),
}

/// The next number of a channel, and the records that wait for it.
#[derive(Debug)]
pub(crate) struct Order<T> {
    next: u64,
    held: BTreeMap<u64, T>,
}

impl<T> Order<T> {
    /// Begins after this number.
    pub(crate) const fn after(number: u64) -> Self {
        Self { next: number.saturating_add(1), held: BTreeMap::new() }
    }

    /// Returns the last number that was passed.
    pub(crate) const fn last(&self) -> u64 {
        self.next - 1
    }

    /// Passes this number, if it is the next one. Otherwise nothing changes.
    pub(crate) const fn pass(&mut self, number: u64) -> bool {
        let is_next = number == self.next;
        if is_next {
            self.next = self.next.saturating_add(1);
        }
        is_next
    }

    /// Passes all numbers up to this one. Returns how many they were.
    pub(crate) const fn skip_to(&mut self, number: u64) -> u64 {
        let skipped = number.saturating_sub(self.last());
        self.next = self.next.saturating_add(skipped);
        skipped
    }

    /// Holds a record until its turn. Returns it if its number was passed before, or is there twice.
    pub(crate) fn hold(&mut self, number: u64, record: T) -> Result<(), T> {
        if number < self.next || self.held.contains_key(&number) {
            return Err(record);
        }
        self.held.insert(number, record);
        Ok(())
    }

    /// Returns the held record with the lowest number.
    pub(crate) fn first_held(&self) -> Option<&T> {
        self.held.first_key_value().map(|(_, record)| record)
    }

    /// Returns the next step, or `None` while the next number is awaited. With `gives_up` none is.
    pub(crate) fn step(&mut self, gives_up: bool) -> Option<Step<T>> {
        let (first, last) = (*self.held.first_key_value()?.0, *self.held.last_key_value()?.0);
        if first == self.next {
            self.next = self.next.saturating_add(1);
            return self.held.remove(&first).map(Step::Next);
        }
        (gives_up || last - self.next >= WINDOW).then(|| Step::Missing(self.skip_to(first - 1)))
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn steps(order: &mut Order<u64>, gives_up: bool) -> Vec<Step<u64>> {
        std::iter::from_fn(|| order.step(gives_up)).collect()
    }

    #[test]
    fn late_number_is_awaited() {
        let mut order = Order::after(4);
        assert!(order.pass(5) && !order.pass(7));
        assert_eq!((order.hold(7, 7), order.hold(8, 8)), (Ok(()), Ok(())));
        assert!(steps(&mut order, false).is_empty());
        assert!(order.pass(6));
        assert_eq!(steps(&mut order, false), [Step::Next(7), Step::Next(8)]);
        assert_eq!((order.hold(8, 8), order.last()), (Err(8), 8));
    }

    #[test]
    fn number_is_missing_after_the_window() {
        let mut order = Order::after(0);
        assert_eq!(order.hold(3, 3), Ok(()));
        assert_eq!(order.hold(WINDOW, WINDOW), Ok(()));
        assert!(steps(&mut order, false).is_empty());
        assert_eq!(order.hold(WINDOW + 1, WINDOW + 1), Ok(()));
        assert_eq!(steps(&mut order, false), [Step::Missing(2), Step::Next(3)]);
        let rest = [Step::Missing(WINDOW - 4), Step::Next(WINDOW), Step::Next(WINDOW + 1)];
        assert_eq!(steps(&mut order, true), rest);
    }
}
