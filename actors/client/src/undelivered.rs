//! Unconfirmed messages that were not delivered, as reported by the node and by this endpoint.

use std::time::Duration;

use sinew_model::rejections::{is_of_an_end, reason_of};
use sinew_protocol::payload;
use sinew_runtime::{outcome::Rejection, tid::Tid, time::Time, undelivered::Undelivered};

use super::{Endpoint, incoming::WhenFull};

/// Maximum number of distinct pairs of destination and reason until the application reads the reports. Beyond
/// it only the reasons are distinguished.
const ENTRIES_MAX: usize = 64;
/// Time between two log lines about messages that this endpoint has refused.
const LOG_INTERVAL: Duration = Duration::from_secs(10);

/// The node's reports, until the application reads them.
#[derive(Debug, Default)]
pub(super) struct Refusals {
    entries: Vec<Undelivered>,
    /// Messages that this endpoint has refused and that are not logged yet.
    unlogged: u64,
    logged: Option<Time>,
    /// The program reads the reports, so they are not logged.
    is_taken: bool,
    /// Messages that were reported and not logged yet, with the time of the last such line.
    unshown: u64,
    shown: Option<Time>,
}

impl Refusals {
    /// Records a report of the node of endpoint `own`.
    pub(super) fn on_report(&mut self, own: Tid, report: payload::Undelivered, now: Time) {
        for entry in report.entries {
            let undelivered = Undelivered {
                destination: Tid::from_bits(entry.to),
                name: entry.name,
                kind: entry.kind,
                class: entry.class,
                why: reason_of(entry.why),
                count: entry.count,
                since: Time::from_nanos(entry.since),
                first_sequence: entry.first,
                last_sequence: entry.last,
            };
            self.show(own, &undelivered, now);
            self.add(undelivered);
        }
    }

    /// Logs the first report, and then one periodically, as long as the program does not read them.
    fn show(&mut self, own: Tid, undelivered: &Undelivered, now: Time) {
        self.unshown = self.unshown.saturating_add(undelivered.count);
        if !self.is_taken && self.shown.is_none_or(|shown| now >= shown + LOG_INTERVAL) {
            let messages = std::mem::take(&mut self.unshown);
            self.shown = Some(now);
            if is_of_an_end(undelivered.why) {
                sinew_runtime::log::here!(info: endpoint = %own, messages, "{undelivered}");
            } else {
                sinew_runtime::log::here!(warn: endpoint = %own, messages, "{undelivered}; `take_undelivered` has each of them");
            }
        }
    }

    /// Records messages that this endpoint, `own`, has refused without a report to their senders.
    pub(super) fn count_own(&mut self, own: Tid, count: u64, now: Time) {
        if count > 0 {
            self.add(unsent(own, Rejection::QueueFull, count, now));
        }
        self.unlogged = self.unlogged.saturating_add(count);
        if self.unlogged > 0 && self.logged.is_none_or(|logged| now >= logged + LOG_INTERVAL) {
            let messages = std::mem::take(&mut self.unlogged);
            self.logged = Some(now);
            sinew_runtime::log::here!(warn:
                endpoint = %own,
                messages,
                "messages for it were refused: while it waited for an answer more came than it keeps; it is to receive more often"
            );
        }
    }

    /// Adds a report.
    pub(super) fn add(&mut self, undelivered: Undelivered) {
        let known = self.find(&undelivered);
        let is_full = self.entries.len() >= ENTRIES_MAX;
        let undelivered = if known.is_none() && is_full {
            unsent(Tid::NONE, undelivered.why, undelivered.count, undelivered.since)
        } else {
            undelivered
        };
        match known.or_else(|| self.find(&undelivered)) {
            Some(at) => {
                let known = &mut self.entries[at];
                known.count = known.count.saturating_add(undelivered.count);
                let firsts = [known.first_sequence, undelivered.first_sequence];
                known.first_sequence = firsts.into_iter().flatten().min();
                known.last_sequence = known.last_sequence.max(undelivered.last_sequence);
            }
            None => self.entries.push(undelivered),
        }
    }

    fn find(&self, like: &Undelivered) -> Option<usize> {
        let key = |of: &Undelivered| (of.destination, of.kind, of.why);
        self.entries.iter().position(|known| key(known) == key(like))
    }

    /// Takes the oldest report.
    fn take(&mut self) -> Option<Undelivered> {
        self.is_taken = true;
        (!self.entries.is_empty()).then(|| self.entries.remove(0))
    }
}

/// Returns a report of messages of which only the destination is known.
pub(super) const fn unsent(destination: Tid, why: Rejection, count: u64, since: Time) -> Undelivered {
    Undelivered {
        destination,
        name: None,
        kind: None,
        class: None,
        why,
        count,
        since,
        first_sequence: None,
        last_sequence: None,
    }
}

impl Endpoint {
    /// Returns the next report of unconfirmed messages that were not delivered, here or by another node: one
    /// for each destination, type and reason, with the number of messages; `None` if there is nothing new.
    /// Never waits. The first refusal is reported at once, later ones every 100 ms together. A report that
    /// has not arrived when the connection ends is lost.
    ///
    /// Until the first call of this method the endpoint logs a warning about reports, at most one every 10 s.
    ///
    /// Values of class Stream that waited for room in a direct link when it ended are counted here too, with
    /// their destination, as [`Closed`](Rejection::Closed). Unconfirmed messages in its ring at that time are
    /// not counted: their outcome is unknown.
    ///
    /// Messages that this endpoint has refused without a report to their senders are counted here too, with
    /// the endpoint as the destination.
    ///
    /// If the outcome of a single message matters, send it [confirmed](super::MessageBuilder::confirmed).
    ///
    /// # Examples
    ///
    /// ```
    /// use sinew::Endpoint;
    ///
    /// /// Prints the messages that were not delivered; called once a second.
    /// fn report(endpoint: &mut Endpoint) {
    ///     while let Some(report) = endpoint.take_undelivered() {
    ///         eprintln!("{report}");
    ///     }
    /// }
    /// ```
    pub fn take_undelivered(&mut self) -> Option<Undelivered> {
        // The error appears again when messages are received.
        let _ = self.poll_incoming(None, WhenFull::Leave, Time::now());
        self.refusals.take()
    }
}

#[cfg(test)]
mod tests {
    use sinew_runtime::{
        outcome::Outcome,
        tid::{AppAddress, NodeAddress},
    };

    use super::*;

    fn tid(app: u32) -> Tid {
        Tid::new(NodeAddress::new(1), AppAddress::new(app))
    }

    fn report(to: Tid, why: u8, count: u64) -> payload::Undelivered {
        payload::Undelivered {
            entries: vec![payload::UndeliveredEntry {
                to: to.bits(),
                why,
                count,
                since: count,
                kind: None,
                class: None,
                first: None,
                last: None,
                name: None,
            }],
        }
    }

    #[test]
    fn reports_per_destination_add_up_until_taken() {
        let mut refusals = Refusals::default();
        let full = Outcome::Rejected(Rejection::QueueFull).code();
        refusals.on_report(tid(9), report(tid(1), full, 3), Time::ZERO);
        refusals.on_report(tid(9), report(tid(2), full, 1), Time::ZERO);
        refusals.on_report(tid(9), report(tid(1), full, 4), Time::ZERO);
        let expected = unsent(tid(1), Rejection::QueueFull, 7, Time::from_nanos(3));
        assert_eq!(refusals.take(), Some(expected), "since the first");
        assert_eq!(refusals.take().map(|undelivered| undelivered.destination), Some(tid(2)));
        assert_eq!(refusals.take(), None);
    }

    #[test]
    fn own_refusals_are_counted_and_logged_rarely() {
        let mut refusals = Refusals::default();
        let at = |seconds| Time::ZERO + Duration::from_secs(seconds);
        refusals.count_own(tid(1), 0, at(1));
        assert_eq!((refusals.take(), refusals.logged), (None, None));
        refusals.count_own(tid(1), 5, at(2));
        refusals.count_own(tid(1), 2, at(3));
        assert_eq!((refusals.unlogged, refusals.logged), (2, Some(at(2))), "the log says it of the first 5");
        refusals.count_own(tid(1), 0, at(12));
        assert_eq!((refusals.unlogged, refusals.logged), (0, Some(at(12))));
        let expected = unsent(tid(1), Rejection::QueueFull, 7, at(2));
        assert_eq!((refusals.take(), refusals.take()), (Some(expected), None));
    }

    #[test]
    fn reports_are_bounded_without_losing_counts() {
        let mut refusals = Refusals::default();
        for app in 0..1_000 {
            refusals.on_report(tid(9), report(tid(app), (app % 256) as u8, 1), Time::ZERO);
        }
        assert!(refusals.entries.len() <= ENTRIES_MAX + 13, "{} entries", refusals.entries.len());
        assert_eq!(
            std::iter::from_fn(|| refusals.take()).map(|undelivered| undelivered.count).sum::<u64>(),
            1_000
        );
    }
}
