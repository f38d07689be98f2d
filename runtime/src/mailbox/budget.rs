//! A byte bound that several queues share.

use std::sync::{
    Arc,
    atomic::{AtomicUsize, Ordering},
};

/// A bound in bytes of payloads that several [`ClassQueue`](super::ClassQueue)s share, in addition to their
/// own bounds. It may be part of a larger budget.
#[derive(Debug)]
pub struct Budget {
    held: AtomicUsize,
    max: usize,
    whole: Option<Arc<Self>>,
}

impl Budget {
    /// Creates a budget of at most `max` bytes.
    #[must_use]
    pub fn new(max: usize) -> Arc<Self> {
        Arc::new(Self { held: AtomicUsize::new(0), max, whole: None })
    }

    /// Creates a budget of at most `max` bytes, which also count in `whole`.
    #[must_use]
    pub fn part_of(whole: &Arc<Self>, max: usize) -> Arc<Self> {
        Arc::new(Self { held: AtomicUsize::new(0), max, whole: Some(whole.clone()) })
    }

    /// Returns the bytes that are held now.
    #[must_use]
    pub fn held(&self) -> usize {
        self.held.load(Ordering::Relaxed)
    }

    /// Returns whether there is room for this many more bytes.
    pub(super) fn has_room_for(&self, bytes: usize) -> bool {
        let has_room = self.held().checked_add(bytes).is_some_and(|sum| sum <= self.max);
        has_room && self.whole.as_ref().is_none_or(|whole| whole.has_room_for(bytes))
    }

    /// Adds held bytes, if there is room for them.
    pub(super) fn take(&self, bytes: usize) -> bool {
        let with = |held: usize| held.checked_add(bytes).filter(|sum| *sum <= self.max);
        if self.held.fetch_update(Ordering::Relaxed, Ordering::Relaxed, with).is_err() {
            return false;
        }
        let has_room = self.whole.as_ref().is_none_or(|whole| whole.take(bytes));
        if !has_room {
            self.held.fetch_sub(bytes, Ordering::Relaxed);
        }
        has_room
    }

    /// Adds held bytes, beyond the bound.
    pub(super) fn add(&self, bytes: usize) {
        self.held.fetch_add(bytes, Ordering::Relaxed);
        if let Some(whole) = &self.whole {
            whole.add(bytes);
        }
    }

    /// Subtracts held bytes.
    pub(super) fn release(&self, bytes: usize) {
        self.held.fetch_sub(bytes, Ordering::Relaxed);
        if let Some(whole) = &self.whole {
            whole.release(bytes);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn rejection_by_the_total_holds_nothing_in_the_part() {
        let whole = Budget::new(100);
        let (one, other) = (Budget::part_of(&whole, 80), Budget::part_of(&whole, 80));
        assert!(one.take(80) && !one.take(1));
        assert!(!other.take(30) && other.take(20));
        assert_eq!((one.held(), other.held(), whole.held()), (80, 20, 100));
        one.release(80);
        assert!(other.take(60));
        assert_eq!((one.held(), other.held(), whole.held()), (0, 80, 80));
    }
}
