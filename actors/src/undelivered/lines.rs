//! Lines in the log of which each has a key: the first at once, later ones of the same key together. Pure.

use std::{collections::BTreeMap, time::Duration};

use sinew_runtime::time::Time;

/// Shortest time between two lines with one key.
pub(crate) const LOG_AGAIN: Duration = Duration::from_secs(10);
/// Keys that are told apart. For one more the one that was noted longest ago is forgotten.
const KEYS_MAX: usize = 64;

/// What is known of one key. `V` is about the latest.
#[derive(Clone, Debug)]
pub(crate) struct Line<V> {
    /// Number of notes in all.
    pub(crate) count: u64,
    /// Number of notes that no line has shown.
    pub(crate) unlogged: u64,
    /// Time of the latest note.
    pub(crate) last: Time,
    pub(crate) about: V,
    logged: Option<Time>,
}

/// A bounded table of such lines.
#[derive(Debug)]
pub(crate) struct Lines<K, V>(BTreeMap<K, Line<V>>);

impl<K, V> Default for Lines<K, V> {
    fn default() -> Self {
        Self(BTreeMap::new())
    }
}

impl<K: Ord + Copy, V: Clone> Lines<K, V> {
    /// Notes `count` more. Returns whether a line is due.
    pub(crate) fn note(&mut self, now: Time, key: K, count: u64, about: V) -> bool {
        if !self.0.contains_key(&key) && self.0.len() >= KEYS_MAX {
            let oldest = self.0.iter().min_by_key(|(_, line)| line.last).map(|(key, _)| *key);
            oldest.map(|oldest| self.0.remove(&oldest));
        }
        let new = || Line { count: 0, unlogged: 0, last: now, about: about.clone(), logged: None };
        let line = self.0.entry(key).or_insert_with(new);
        line.count = line.count.saturating_add(count);
        line.unlogged = line.unlogged.saturating_add(count);
        (line.last, line.about) = (now, about);
        line.is_due(now)
    }

    /// The lines that are due at `now`; they count as shown.
    pub(crate) fn take_due(&mut self, now: Time) -> Vec<(K, Line<V>)> {
        let due = self.0.iter_mut().filter(|(_, line)| line.is_due(now));
        let take = |(key, line): (&K, &mut Line<V>)| {
            let taken = line.clone();
            (line.unlogged, line.logged) = (0, Some(now));
            (*key, taken)
        };
        due.map(take).collect()
    }

    /// All that is known, the latest first.
    pub(crate) fn latest(&self) -> Vec<(K, Line<V>)> {
        let mut all: Vec<_> = self.0.iter().map(|(key, line)| (*key, line.clone())).collect();
        all.sort_by_key(|(_, line)| std::cmp::Reverse(line.last));
        all
    }
}

impl<V> Line<V> {
    fn is_due(&self, now: Time) -> bool {
        self.unlogged > 0 && self.logged.is_none_or(|logged| now >= logged + LOG_AGAIN)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(seconds: u64) -> Time {
        Time::ZERO + Duration::from_secs(seconds)
    }

    fn shown(lines: &mut Lines<u64, ()>, now: Time) -> Vec<(u64, u64)> {
        lines.take_due(now).into_iter().map(|(key, line)| (key, line.unlogged)).collect()
    }

    #[test]
    fn the_first_note_is_shown_at_once_and_later_ones_together() {
        let mut lines = Lines::default();
        assert!(lines.note(at(0), 1, 1, ()));
        assert_eq!(shown(&mut lines, at(0)), [(1, 1)]);
        for second in 1..10 {
            assert!(!lines.note(at(second), 1, 100, ()));
        }
        assert!(lines.note(at(9), 2, 1, ()), "another key has a line of its own");
        assert_eq!(shown(&mut lines, at(9)), [(2, 1)]);
        assert_eq!(shown(&mut lines, at(10)), [(1, 900)]);
        assert_eq!(shown(&mut lines, at(100)), [], "nothing was noted since");
    }

    #[test]
    fn so_many_keys_are_kept_and_the_oldest_is_forgotten() {
        let mut lines = Lines::default();
        for key in 0..1_000 {
            lines.note(at(key), key, u64::MAX, ());
            lines.note(at(key), key, u64::MAX, ());
        }
        let kept = lines.latest();
        assert_eq!((kept.len(), kept[0].0, kept[0].1.count), (KEYS_MAX, 999, u64::MAX));
        assert_eq!(kept[KEYS_MAX - 1].0, 1_000 - KEYS_MAX as u64);
    }
}
