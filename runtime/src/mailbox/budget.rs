//! Bytes that several queues may hold together.

use std::sync::{
    Arc,
    atomic::{AtomicUsize, Ordering},
};

/// A bound in bytes of payloads that several [`ClassQueue`](super::ClassQueue)s share, beside the bounds that each has for
/// itself. It may be part of a larger one.
#[derive(Debug)]
pub struct Budget {
    held: AtomicUsize,
    max: usize,
    whole: Option<Arc<Self>>,
}

impl Budget {
    /// At most `max` bytes.
    #[must_use]
    pub fn new(max: usize) -> Arc<Self> {
        Arc::new(Self { held: AtomicUsize::new(0), max, whole: None })
    }

    /// At most `max` bytes, which count in `whole` as well.
    #[must_use]
    pub fn part_of(whole: &Arc<Self>, max: usize) -> Arc<Self> {
        Arc::new(Self { held: AtomicUsize::new(0), max, whole: Some(whole.clone()) })
    }

    /// Bytes that are held now.
    #[must_use]
    pub fn held(&self) -> usize {
        self.held.load(Ordering::Relaxed)
    }

    /// Whether there is room for so many bytes more.
    pub(super) fn has_room_for(&self, bytes: usize) -> bool {
        let has_room = self.held().checked_add(bytes).is_some_and(|sum| sum <= self.max);
        has_room && self.whole.as_ref().is_none_or(|whole| whole.has_room_for(bytes))
    }

    /// Holds so many bytes more, if there is room for them.
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

    /// Holds so many bytes more in any case.
    pub(super) fn add(&self, bytes: usize) {
        self.held.fetch_add(bytes, Ordering::Relaxed);
        if let Some(whole) = &self.whole {
            whole.add(bytes);
        }
    }

    /// So many bytes are held no more.
    pub(super) fn give(&self, bytes: usize) {
        self.held.fetch_sub(bytes, Ordering::Relaxed);
        if let Some(whole) = &self.whole {
            whole.give(bytes);
        }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn what_has_no_room_in_the_whole_is_not_held_in_the_part_either() {
        let whole = Budget::new(100);
        let (one, other) = (Budget::part_of(&whole, 80), Budget::part_of(&whole, 80));
        assert!(one.take(80) && !one.take(1));
        assert!(!other.take(30) && other.take(20));
        assert_eq!((one.held(), other.held(), whole.held()), (80, 20, 100));
        one.give(80);
        assert!(other.take(60));
        assert_eq!((one.held(), other.held(), whole.held()), (0, 80, 80));
    }
}
