//! Unconfirmed messages that were refused, until their sender is told. Pure.
//!
//! A flood of refusals is one entry that counts. So it costs its reader one report in a tenth of a second at most, and the node a table of
//! a fixed size.

use std::time::Duration;

use sinew_runtime::{
    outcome::Rejection,
    tid::{AppAddress, Tid},
    time::Time,
    wire::{Class, Header, Kind},
};

/// Destinations, types and reasons that are told apart between two reports; the messages beyond them are reported without a destination.
pub(super) const ENTRIES_MAX: usize = 16;
/// Reasons, each of one source, that are kept without a destination beside those.
const WITHOUT_DESTINATION_MAX: usize = 16;
/// Shortest time between two reports.
pub(super) const PAUSE: Duration = Duration::from_millis(100);

/// Refused messages of one source to one destination, of one type, for one reason.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(crate) struct Entry {
    pub(crate) source: AppAddress,
    pub(crate) destination: Tid,
    pub(crate) kind: Option<Kind>,
    pub(crate) class: Option<Class>,
    pub(crate) why: Rejection,
    pub(crate) count: u64,
    pub(crate) since: Time,
    /// Lowest and highest sequence, where they are known.
    pub(crate) first: Option<u64>,
    pub(crate) last: Option<u64>,
}

impl Entry {
    /// `count` messages with this header, refused at `now`.
    pub(crate) const fn of(header: &Header, why: Rejection, count: u64, now: Time) -> Self {
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

/// What one reader is to be told.
#[derive(Debug, Default)]
pub(super) struct Ledger {
    entries: Vec<Entry>,
    /// Nothing is told before this.
    not_before: Option<Time>,
}

impl Ledger {
    /// Adds refused messages. Returns how many had no room.
    pub(super) fn add(&mut self, entry: Entry) -> u64 {
        // A message to nobody at all has no destination either, and is of one type.
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

    /// Whether something is to be told at `now`.
    pub(super) fn is_due(&self, now: Time) -> bool {
        !self.entries.is_empty() && self.not_before.is_none_or(|then| now >= then)
    }

    /// What is to be told at `now`, at most so much; it counts as told.
    pub(super) fn take(&mut self, now: Time, max: usize) -> Vec<Entry> {
        if !self.is_due(now) {
            return Vec::new();
        }
        self.not_before = Some(now + PAUSE);
        let rest = self.entries.split_off(max.min(self.entries.len()));
        std::mem::replace(&mut self.entries, rest)
    }

    /// Whether nothing would be lost with it at `now`.
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

    fn count(ledger: &mut Ledger, to: Tid, now: Time) {
        assert_eq!(ledger.add(entry(to, FULL, now, 0)), 0);
    }

    fn told(ledger: &mut Ledger, now: Time) -> Vec<(Tid, u64)> {
        ledger.take(now, usize::MAX).into_iter().map(|entry| (entry.destination, entry.count)).collect()
    }

    #[test]
    fn the_first_refusal_is_told_at_once_and_those_after_it_together() {
        let mut ledger = Ledger::default();
        count(&mut ledger, tid(1), at(0));
        assert_eq!(told(&mut ledger, at(0)), [(tid(1), 1)]);
        for millis in 1..100 {
            count(&mut ledger, tid(1), at(millis));
            count(&mut ledger, tid(2), at(millis));
            assert!(!ledger.is_due(at(millis)), "{millis} ms after the first");
        }
        let undelivered = ledger.take(at(100), usize::MAX);
        assert_eq!(undelivered[0].since, at(1), "since the first of these");
        assert_eq!(undelivered.iter().map(|entry| entry.count).collect::<Vec<_>>(), [99, 99]);
        assert!(!ledger.is_due(at(10_000)), "nothing was refused since");
    }

    #[test]
    fn reasons_and_types_are_told_apart() {
        let mut ledger = Ledger::default();
        let first = entry(tid(1), FULL, at(0), 7);
        for entry in [
            first,
            Entry { why: Rejection::NoSuchApplication, ..first },
            Entry { kind: Some(Kind::named("demo.torque")), ..first },
            Entry { first: Some(5), last: Some(9), ..first },
        ] {
            ledger.add(entry);
        }
        let taken = ledger.take(at(0), usize::MAX);
        assert_eq!(taken.iter().map(|entry| entry.count).collect::<Vec<_>>(), [2, 1, 1]);
        assert_eq!((taken[0].first, taken[0].last), (Some(5), Some(9)));
    }

    #[test]
    fn destinations_beyond_the_bound_are_counted_together() {
        let mut ledger = Ledger::default();
        for app in 0..1_000 {
            count(&mut ledger, tid(app), at(0));
        }
        let told = told(&mut ledger, at(0));
        assert_eq!(told.len(), ENTRIES_MAX + 1);
        assert_eq!(told.last(), Some(&(Tid::NONE, 1_000 - ENTRIES_MAX as u64)));
    }

    #[test]
    fn sources_beyond_the_bound_are_said_to_have_no_room() {
        let mut ledger = Ledger::default();
        let from = |app| Entry { source: AppAddress::new(app), ..entry(tid(1), FULL, at(0), 1) };
        let without: u64 = (0..1_000).map(|app| ledger.add(from(app))).sum();
        assert_eq!(ledger.entries.len(), ENTRIES_MAX + WITHOUT_DESTINATION_MAX);
        assert_eq!(without, 1_000 - (ENTRIES_MAX + WITHOUT_DESTINATION_MAX) as u64);
    }

    #[test]
    fn counts_saturate() {
        let mut ledger = Ledger::default();
        for _ in 0..2 {
            ledger.add(Entry { count: u64::MAX, ..entry(tid(1), FULL, at(0), 1) });
        }
        assert_eq!(told(&mut ledger, at(0)), [(tid(1), u64::MAX)]);
    }

    #[test]
    fn what_does_not_fit_into_a_report_is_told_in_those_after_it() {
        let mut ledger = Ledger::default();
        for app in 0..1_000 {
            count(&mut ledger, tid(app), at(0));
        }
        let reports = (0..).map(|tenth| ledger.take(at(100 * tenth), 1)).take_while(|told| !told.is_empty());
        let told: Vec<_> = reports.inspect(|told| assert_eq!(told.len(), 1)).flatten().collect();
        assert_eq!(told.len(), ENTRIES_MAX + 1);
        assert_eq!(told.iter().map(|entry| entry.count).sum::<u64>(), 1_000);
        assert!(ledger.is_over(at(10_000)));
    }
}
