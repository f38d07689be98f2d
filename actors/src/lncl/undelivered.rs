//! What of a client's unconfirmed messages nobody has taken, until the client is told. Pure.
//!
//! A flood of refusals is one entry that counts. So it costs its client one frame in a tenth of a second at most, and the
//! node a table of a fixed size.

use std::time::Duration;

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    tid::{AppAddress, Tid},
    time::Time,
};

use super::payload::{Undelivered, UndeliveredEntry};

/// Destinations and reasons that are told apart between two frames; what comes beyond them is told of no destination.
pub(super) const ENTRIES_MAX: usize = 16;
/// Bytes of a frame's payload beside its entries, at most.
const FRAME_BYTES: usize = 12;
/// Bytes of one entry, at most.
const ENTRY_BYTES: usize = 49;
/// Shortest time between two frames.
const PAUSE: Duration = Duration::from_millis(100);

/// Whether the sender of an unconfirmed message misses something when nobody takes it. A group without members is no fault, nobody at all is
/// one.
pub(crate) fn is_fault(destination: Tid, why: Rejection) -> bool {
    let is_to_many = !destination.is_single() && destination.app != AppAddress::NONE;
    !is_to_many || why != Rejection::NoSuchApplication
}

/// What one client is to be told.
#[derive(Debug)]
pub(super) struct Ledger {
    entries: Vec<UndeliveredEntry>,
    /// As many as one frame has.
    told_at_once: usize,
    /// Nothing is told before this.
    not_before: Option<Time>,
}

impl Ledger {
    /// That of a client whose longest payload has so many bytes. The shortest that can be configured has room for one entry; the
    /// others have a frame of their own then.
    pub(super) fn new(payload_max: usize) -> Self {
        let told_at_once = (payload_max.saturating_sub(FRAME_BYTES) / ENTRY_BYTES).max(1);
        Self { entries: Vec::new(), told_at_once, not_before: None }
    }

    /// One more message to `destination` was refused at `now`.
    pub(super) fn count(&mut self, destination: Tid, why: Rejection, now: Time) {
        let why = Outcome::Rejected(why).code();
        let known = self.find(destination, why);
        let at =
            known.or_else(|| (self.entries.len() < ENTRIES_MAX).then(|| self.begin(destination, why, now)));
        // Past the bound the reason counts alone; of these there are few.
        let at = at.or_else(|| self.find(Tid::NONE, why)).unwrap_or_else(|| self.begin(Tid::NONE, why, now));
        self.entries[at].count += 1;
    }

    /// What is to be told at `now`, if anything is; it counts as told.
    pub(super) fn take(&mut self, now: Time) -> Option<Undelivered> {
        if self.entries.is_empty() || self.not_before.is_some_and(|then| now < then) {
            return None;
        }
        self.not_before = Some(now + PAUSE);
        let rest = self.entries.split_off(self.told_at_once.min(self.entries.len()));
        Some(Undelivered { entries: std::mem::replace(&mut self.entries, rest) })
    }

    /// It could not be told: it is told later, with what comes until then.
    pub(super) fn put_back(&mut self, untold: Undelivered) {
        for entry in untold.entries {
            match self.find(Tid::from_bits(entry.to), entry.why) {
                Some(at) => self.entries[at].count += entry.count,
                None => self.entries.push(entry),
            }
        }
    }

    fn find(&self, destination: Tid, why: u8) -> Option<usize> {
        self.entries.iter().position(|entry| entry.to == destination.bits() && entry.why == why)
    }

    fn begin(&mut self, destination: Tid, why: u8, now: Time) -> usize {
        self.entries.push(UndeliveredEntry { to: destination.bits(), why, count: 0, since: now.as_nanos() });
        self.entries.len() - 1
    }
}

#[cfg(test)]
mod tests {
    use sinew_runtime::tid::{AppAddress, NodeAddress};

    use super::*;

    const FULL: Rejection = Rejection::QueueFull;

    fn tid(app: u32) -> Tid {
        Tid::new(NodeAddress::new(1), AppAddress::new(app))
    }

    fn at(millis: u64) -> Time {
        Time::from_nanos(1_000_000_000) + Duration::from_millis(millis)
    }

    fn told(ledger: &mut Ledger, now: Time) -> Vec<(u64, u64)> {
        let told = ledger.take(now).map(|undelivered| undelivered.entries).unwrap_or_default();
        told.into_iter().map(|entry| (entry.to, entry.count)).collect()
    }

    #[test]
    fn the_first_refusal_is_told_at_once_and_those_after_it_together() {
        let mut ledger = Ledger::new(1 << 20);
        ledger.count(tid(1), FULL, at(0));
        assert_eq!(told(&mut ledger, at(0)), [(tid(1).bits(), 1)]);
        for millis in 1..100 {
            ledger.count(tid(1), FULL, at(millis));
            ledger.count(tid(2), FULL, at(millis));
            assert!(ledger.take(at(millis)).is_none(), "{millis} ms after the first");
        }
        let undelivered = ledger.take(at(100)).expect("its time has come");
        assert_eq!(undelivered.entries[0].since, at(1).as_nanos(), "since the first of these");
        assert_eq!(undelivered.entries.iter().map(|entry| entry.count).collect::<Vec<_>>(), [99, 99]);
        assert!(ledger.take(at(10_000)).is_none(), "nothing was refused since");
    }

    #[test]
    fn reasons_are_told_apart() {
        let mut ledger = Ledger::new(1 << 20);
        ledger.count(tid(1), FULL, at(0));
        ledger.count(tid(1), Rejection::NoSuchApplication, at(0));
        let whys: Vec<_> = ledger.take(at(0)).unwrap().entries.iter().map(|entry| entry.why).collect();
        assert_eq!(
            whys,
            [Outcome::Rejected(FULL).code(), Outcome::Rejected(Rejection::NoSuchApplication).code()]
        );
    }

    #[test]
    fn destinations_beyond_the_bound_are_counted_together() {
        let mut ledger = Ledger::new(1 << 20);
        for app in 0..1_000 {
            ledger.count(tid(app), FULL, at(0));
        }
        let told = told(&mut ledger, at(0));
        assert_eq!(told.len(), ENTRIES_MAX + 1);
        assert_eq!(told.last(), Some(&(0, 1_000 - ENTRIES_MAX as u64)));
    }

    #[test]
    fn what_could_not_be_told_is_told_later_with_what_came_since() {
        let mut ledger = Ledger::new(1 << 20);
        ledger.count(tid(1), FULL, at(0));
        let untold = ledger.take(at(0)).unwrap();
        ledger.count(tid(1), FULL, at(1));
        ledger.count(tid(2), FULL, at(1));
        ledger.put_back(untold);
        assert_eq!(told(&mut ledger, at(100)), [(tid(1).bits(), 2), (tid(2).bits(), 1)]);
    }

    #[test]
    fn what_does_not_fit_into_a_short_payload_is_told_in_the_frames_after_it() {
        let shortest = 64;
        let mut ledger = Ledger::new(shortest);
        for app in 0..1_000 {
            ledger.count(tid(app), FULL, at(0));
        }
        let frames =
            (0..).map(|tenth| told(&mut ledger, at(100 * tenth))).take_while(|told| !told.is_empty());
        let told: Vec<_> = frames.inspect(|told| assert_eq!(told.len(), 1)).flatten().collect();
        assert_eq!(told.len(), ENTRIES_MAX + 1);
        assert_eq!(told.iter().map(|(_, count)| count).sum::<u64>(), 1_000);
    }

    #[test]
    fn no_frame_is_longer_than_it_is_counted() {
        let longest = || UndeliveredEntry { to: u64::MAX, why: u8::MAX, count: u64::MAX, since: u64::MAX };
        for entries in [0, 1, 15, 16, ENTRIES_MAX + 11] {
            let undelivered = Undelivered { entries: (0..entries).map(|_| longest()).collect() };
            let bytes = rmp_serde::to_vec_named(&undelivered).unwrap().len();
            assert!(bytes <= FRAME_BYTES + entries * ENTRY_BYTES, "{entries} entries have {bytes} bytes");
        }
    }
}
