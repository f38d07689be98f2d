//! Values that a program in C holds by number, so that a number that was given back is rejected, not
//! dereferenced.

use std::sync::atomic::{AtomicU64, Ordering};

/// Bits of a token that hold its index.
const SLOT_BITS: u32 = 16;
/// Number of values ever stored in this process: a token of one endpoint is never valid for another one.
static INSERTED: AtomicU64 = AtomicU64::new(1);

/// Values held by a program, each under a token that no other value of this process ever had.
#[derive(Debug)]
pub(crate) struct HandleTable<T> {
    /// The token and the value of each index.
    slots: Vec<(u64, Option<T>)>,
    free: Vec<usize>,
    limit: usize,
}

impl<T> HandleTable<T> {
    /// Creates storage for at most `limit` values, which is below 65,536.
    pub(crate) const fn new(limit: usize) -> Self {
        assert!(limit < 1 << SLOT_BITS, "a token has too few bits for a slot above the limit");
        Self { slots: Vec::new(), free: Vec::new(), limit }
    }

    pub(crate) const fn is_full(&self) -> bool {
        self.free.is_empty() && self.slots.len() == self.limit
    }

    /// Stores a value; returns it if the storage is full. Allocates only when it holds more values than ever
    /// before.
    pub(crate) fn insert(&mut self, value: T) -> Result<u64, T> {
        let slot = match self.free.pop() {
            Some(slot) => slot,
            None if self.is_full() => return Err(value),
            None => {
                self.slots.push((0, None));
                self.slots.len() - 1
            }
        };
        let token = INSERTED.fetch_add(1, Ordering::Relaxed) << SLOT_BITS | slot as u64;
        self.slots[slot] = (token, Some(value));
        Ok(token)
    }

    pub(crate) fn get_mut(&mut self, token: u64) -> Option<&mut T> {
        let (held, value) = self.slots.get_mut(slot_of(token))?;
        if *held == token { value.as_mut() } else { None }
    }

    /// Removes a value and returns it.
    pub(crate) fn remove(&mut self, token: u64) -> Option<T> {
        let slot = slot_of(token);
        let (held, value) = self.slots.get_mut(slot)?;
        if *held != token {
            return None;
        }
        let value = value.take()?;
        self.free.push(slot);
        Some(value)
    }

    /// Removes all values and returns them.
    pub(crate) fn drain(&mut self) -> impl Iterator<Item = T> {
        self.free.clear();
        std::mem::take(&mut self.slots).into_iter().filter_map(|(_, value)| value)
    }
}

const fn slot_of(token: u64) -> usize {
    (token & ((1 << SLOT_BITS) - 1)) as usize
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn token_is_valid_once_and_only_for_its_value() {
        let mut table = HandleTable::new(2);
        let first = table.insert('a').unwrap();
        assert_eq!(table.get_mut(first), Some(&mut 'a'));
        assert_eq!(table.remove(first), Some('a'));
        let second = table.insert('b').unwrap();
        assert_ne!(first, second);
        for wrong in [first, 0, 1, u64::MAX, second + 1] {
            assert_eq!(table.get_mut(wrong), None, "{wrong}");
            assert_eq!(table.remove(wrong), None, "{wrong}");
        }
        assert_eq!(table.remove(second), Some('b'));
        assert_eq!(table.remove(second), None);
    }

    #[test]
    fn token_of_another_table_is_rejected() {
        let (mut one, mut other) = (HandleTable::new(2), HandleTable::new(1));
        let (here, there) = (one.insert('a').unwrap(), other.insert('b').unwrap());
        assert_eq!((one.remove(there), other.remove(here)), (None, None));
        assert_eq!((one.remove(here), other.remove(there)), (Some('a'), Some('b')));
    }

    #[test]
    fn table_is_bounded_and_drains_completely() {
        let mut table = HandleTable::new(2);
        table.insert(1).unwrap();
        table.insert(2).unwrap();
        assert!(table.is_full());
        assert_eq!(table.insert(3), Err(3));
        assert_eq!(table.drain().collect::<Vec<_>>(), [1, 2]);
        assert!(!table.is_full());
    }
}
