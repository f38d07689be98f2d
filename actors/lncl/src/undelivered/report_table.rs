//! Rejected unconfirmed messages, until they are reported to their sender. Pure.
//!
//! A flood of rejections is one entry with a count. So it costs its reader at most one report per 100 ms, and the node
//! a table of fixed size.

use std::time::Duration;

use sinew_runtime::{
    outcome::Rejection,
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Class, Header, Kind},
};

/// Maximum number of entries by destination, type and reason between two reports. Further messages are reported without
/// a destination.
pub(super) const ENTRIES_MAX: usize = 16;
/// Maximum number of further entries without a destination, by source and reason.
const WITHOUT_DESTINATION_MAX: usize = 16;
/// Shortest time between two reports.
pub(super) const PAUSE: Duration = Duration::from_millis(100);

/// Rejected messages of one source to one destination, of one type, for one reason.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Entry {
    pub source: AppAddress,
    pub destination: Tid,
    pub kind: Option<Kind>,
    pub class: Option<Class>,
    pub why: Rejection,
    pub count: u64,
    pub since: Time,
    /// Lowest and highest sequence, if known.
    pub first: Option<u64>,
    pub last: Option<u64>,
}

impl Entry {
    /// Creates the entry of `count` messages with this header, rejected at `now`.
    pub const fn of(header: &Header, why: Rejection, count: u64, now: Time) -> Self {
        let Header { source, destination, kind, class, sequence, .. } = *header;
        let sequence = if sequence == 0 { None } else { Some(sequence) };
        Self {
            source: source.app,
            destination,
            kind: Some(kind),
            class: Some(class),
            why,
            count,
            since: now,
            first: sequence,
            last: sequence,
        }
    }

    fn is_with(&self, other: &Self) -> bool {
        (self.source, self.destination, self.kind, self.why)
            == (other.source, other.destination, other.kind, other.why)
    }

    fn without_destination(self) -> Self {
        Self { destination: Tid::NONE, kind: None, class: None, first: None, last: None, ..self }
    }

    fn add(&mut self, other: &Self) {
        self.count = self.count.saturating_add(other.count);
        self.since = self.since.min(other.since);
        self.first = [self.first, other.first].into_iter().flatten().min();
        self.last = self.last.max(other.last);
    }
}

/// The pending report of one reader.
#[derive(Debug, Default)]
pub(super) struct ReportTable {
    entries: Vec<Entry>,
    /// Time before which no report is sent.
    not_before: Option<Time>,
}

impl ReportTable {
    /// Adds rejected messages. Returns how many had no room.
    pub(super) fn add(&mut self, entry: Entry) -> u64 {
        // A message to the empty destination has no destination either, and is of one type.
        for (entry, max) in
            [(entry, ENTRIES_MAX), (entry.without_destination(), ENTRIES_MAX + WITHOUT_DESTINATION_MAX)]
        {
            if let Some(known) = self.entries.iter_mut().find(|known| known.is_with(&entry)) {
                known.add(&entry);
                return 0;
            }
            if self.entries.len() < max {
                self.entries.push(entry);
                return 0;
            }
        }
        entry.count
    }

    /// Returns whether a report is due at `now`.
    pub(super) fn is_due(&self, now: Time) -> bool {
        !self.entries.is_empty() && self.not_before.is_none_or(|then| now >= then)
    }

    /// Removes and returns the entries that are due at `now`, at most `max`.
    pub(super) fn take(&mut self, now: Time, max: usize) -> Vec<Entry> {
        if !self.is_due(now) {
            return Vec::new();
        }
        self.not_before = Some(now + PAUSE);
        let rest = self.entries.split_off(max.min(self.entries.len()));
        std::mem::replace(&mut self.entries, rest)
    }

    /// Returns whether the table can be dropped at `now` without a loss.
    pub(super) fn is_over(&self, now: Time) -> bool {
        self.entries.is_empty() && self.not_before.is_none_or(|then| now >= then)
    }
}

#[cfg(test)]
mod tests {
    use sinew_runtime::tid::NodeAddress;

    use super::*;

    const FULL: Rejection = Rejection::QueueFull;

    fn tid(app: u32) -> Tid {
        Tid::new(NodeAddress::new(1), AppAddress::new(app))
    }

    fn at(millis: u64) -> Time {
        Time::from_nanos(1_000_000_000) + Duration::from_millis(millis)
    }

    fn entry(to: Tid, why: Rejection, now: Time, sequence: u64) -> Entry {
        let mut header = Header::new(Kind::named("demo.angle"), tid(9), to);
        header.sequence = sequence;
        Entry::of(&header, why, 1, now)
    }

    fn count(table: &mut ReportTable, to: Tid, now: Time) {
        assert_eq!(table.add(entry(to, FULL, now, 0)), 0);
    }

    fn take_counts(table: &mut ReportTable, now: Time) -> Vec<(Tid, u64)> {
        table.take(now, usize::MAX).into_iter().map(|entry| (entry.destination, entry.count)).collect()
    }

    #[test]
    fn first_refusal_is_reported_immediately_and_later_ones_together() {
        let mut table = ReportTable::default();
        count(&mut table, tid(1), at(0));
        assert_eq!(take_counts(&mut table, at(0)), [(tid(1), 1)]);
        for millis in 1..100 {
            count(&mut table, tid(1), at(millis));
            count(&mut table, tid(2), at(millis));
            assert!(!table.is_due(at(millis)), "{millis} ms after the first");
        }
        let undelivered = table.take(at(100), usize::MAX);
        assert_eq!(undelivered[0].since, at(1), "since the first of these");
        assert_eq!(undelivered.iter().map(|entry| entry.count).collect::<Vec<_>>(), [99, 99]);
        assert!(!table.is_due(at(10_000)), "nothing was refused since");
    }

    #[test]
    fn reasons_and_types_are_reported_separately() {
        let mut table = ReportTable::default();
        let first = entry(tid(1), FULL, at(0), 7);
        for entry in [
            first,
            Entry { why: Rejection::NoSuchApplication, ..first },
            Entry { kind: Some(Kind::named("demo.torque")), ..first },
            Entry { first: Some(5), last: Some(9), ..first },
        ] {
            table.add(entry);
        }
        let taken = table.take(at(0), usize::MAX);
        assert_eq!(taken.iter().map(|entry| entry.count).collect::<Vec<_>>(), [2, 1, 1]);
        assert_eq!((taken[0].first, taken[0].last), (Some(5), Some(9)));
    }

    #[test]
    fn destinations_beyond_the_bound_are_counted_together() {
        let mut table = ReportTable::default();
        for app in 0..1_000 {
            count(&mut table, tid(app), at(0));
        }
        let taken = take_counts(&mut table, at(0));
        assert_eq!(taken.len(), ENTRIES_MAX + 1);
        assert_eq!(taken.last(), Some(&(Tid::NONE, 1_000 - ENTRIES_MAX as u64)));
    }

    #[test]
    fn sources_beyond_the_bound_are_reported_without_room() {
        let mut table = ReportTable::default();
        let from = |app| Entry { source: AppAddress::new(app), ..entry(tid(1), FULL, at(0), 1) };
        let without: u64 = (0..1_000).map(|app| table.add(from(app))).sum();
        assert_eq!(table.entries.len(), ENTRIES_MAX + WITHOUT_DESTINATION_MAX);
        assert_eq!(without, 1_000 - (ENTRIES_MAX + WITHOUT_DESTINATION_MAX) as u64);
    }

    #[test]
    fn counts_saturate_at_their_maximum() {
        let mut table = ReportTable::default();
        for _ in 0..2 {
            table.add(Entry { count: u64::MAX, ..entry(tid(1), FULL, at(0), 1) });
        }
        assert_eq!(take_counts(&mut table, at(0)), [(tid(1), u64::MAX)]);
    }

    #[test]
    fn refusals_beyond_one_report_follow_in_later_ones() {
        let mut table = ReportTable::default();
        for app in 0..1_000 {
            count(&mut table, tid(app), at(0));
        }
        let reports = (0..).map(|tenth| table.take(at(100 * tenth), 1)).take_while(|taken| !taken.is_empty());
        let taken: Vec<_> = reports.inspect(|taken| assert_eq!(taken.len(), 1)).flatten().collect();
        assert_eq!(taken.len(), ENTRIES_MAX + 1);
        assert_eq!(taken.iter().map(|entry| entry.count).sum::<u64>(), 1_000);
        assert!(table.is_over(at(10_000)));
    }
}
