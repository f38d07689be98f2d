//! Rate-limited log lines by key: the first is due at once, later ones of the same key are combined. Pure.

use std::{collections::BTreeMap, time::Duration};

use sinew_runtime::time::Time;

/// Shortest time between two lines with one key.
pub(super) const LOG_INTERVAL: Duration = Duration::from_secs(10);
/// Maximum number of keys. A further one replaces the key with the oldest note.
const KEYS_MAX: usize = 64;

/// The state of one key. `V` describes the latest note.
#[derive(Clone, Debug)]
pub struct LogLine<V> {
    /// Number of notes in all.
    pub count: u64,
    /// Number of notes that no line has shown.
    pub unlogged: u64,
    /// Time of the latest note.
    pub last: Time,
    pub about: V,
    logged: Option<Time>,
}

/// A bounded table of such lines.
#[derive(Debug)]
pub(super) struct LogLines<K, V>(BTreeMap<K, LogLine<V>>);

impl<K, V> Default for LogLines<K, V> {
    fn default() -> Self {
        Self(BTreeMap::new())
    }
}

impl<K: Ord + Copy, V: Clone> LogLines<K, V> {
    /// Adds `count` notes. Returns whether a line is due.
    pub(super) fn note(&mut self, now: Time, key: K, count: u64, about: V) -> bool {
        if !self.0.contains_key(&key) && self.0.len() >= KEYS_MAX {
            let oldest = self.0.iter().min_by_key(|(_, line)| line.last).map(|(key, _)| *key);
            oldest.map(|oldest| self.0.remove(&oldest));
        }
        let new = || LogLine { count: 0, unlogged: 0, last: now, about: about.clone(), logged: None };
        let line = self.0.entry(key).or_insert_with(new);
        line.count = line.count.saturating_add(count);
        line.unlogged = line.unlogged.saturating_add(count);
        (line.last, line.about) = (now, about);
        line.is_due(now)
    }

    /// Returns the lines that are due at `now`, and marks them as logged.
    pub(super) fn take_due(&mut self, now: Time) -> Vec<(K, LogLine<V>)> {
        let due = self.0.iter_mut().filter(|(_, line)| line.is_due(now));
        let take = |(key, line): (&K, &mut LogLine<V>)| {
            let taken = line.clone();
            (line.unlogged, line.logged) = (0, Some(now));
            (*key, taken)
        };
        due.map(take).collect()
    }

    /// Returns whether notes are left that no line has shown.
    pub(super) fn has_unlogged(&self) -> bool {
        self.0.values().any(|line| line.unlogged > 0)
    }

    /// Returns all lines, the latest first.
    pub(super) fn latest(&self) -> Vec<(K, LogLine<V>)> {
        let mut all: Vec<_> = self.0.iter().map(|(key, line)| (*key, line.clone())).collect();
        all.sort_by_key(|(_, line)| std::cmp::Reverse(line.last));
        all
    }
}

impl<V> LogLine<V> {
    fn is_due(&self, now: Time) -> bool {
        self.unlogged > 0 && self.logged.is_none_or(|logged| now >= logged + LOG_INTERVAL)
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    fn at(seconds: u64) -> Time {
        Time::ZERO + Duration::from_secs(seconds)
    }

    fn shown(lines: &mut LogLines<u64, ()>, now: Time) -> Vec<(u64, u64)> {
        lines.take_due(now).into_iter().map(|(key, line)| (key, line.unlogged)).collect()
    }

    #[test]
    fn first_note_is_shown_immediately_and_later_ones_together() {
        let mut lines = LogLines::default();
        assert!(lines.note(at(0), 1, 1, ()));
        assert_eq!(shown(&mut lines, at(0)), [(1, 1)]);
        for second in 1..10 {
            assert!(!lines.note(at(second), 1, 100, ()));
        }
        assert!(lines.note(at(9), 2, 1, ()), "another key has a line of its own");
        assert_eq!(shown(&mut lines, at(9)), [(2, 1)]);
        assert!(lines.has_unlogged());
        assert_eq!(shown(&mut lines, at(10)), [(1, 900)]);
        assert!(!lines.has_unlogged());
        assert_eq!(shown(&mut lines, at(100)), [], "nothing was noted since");
    }

    #[test]
    fn oldest_key_is_forgotten_beyond_the_limit() {
        let mut lines = LogLines::default();
        for key in 0..1_000 {
            lines.note(at(key), key, u64::MAX, ());
            lines.note(at(key), key, u64::MAX, ());
        }
        let kept = lines.latest();
        assert_eq!((kept.len(), kept[0].0, kept[0].1.count), (KEYS_MAX, 999, u64::MAX));
        assert_eq!(kept[KEYS_MAX - 1].0, 1_000 - KEYS_MAX as u64);
    }
}
