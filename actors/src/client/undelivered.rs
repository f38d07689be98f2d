//! Unconfirmed messages that were not delivered: what the node reports of them, and this endpoint.

use std::time::Duration;

use sinew_runtime::{outcome::Rejection, tid::Tid, time::Time, undelivered::Undelivered};

use super::{Endpoint, incoming::WhenFull};
use crate::{
    lncl::payload,
    undelivered::{is_of_an_end, reason_of},
};

/// Destinations and reasons that are told apart at most, until the application looks. Beyond them only the reasons are.
const ENTRIES_MAX: usize = 64;
/// Time between two lines in the log about messages that this endpoint has refused.
const LOG_AGAIN: Duration = Duration::from_secs(10);

/// What the node has said, until the application looks.
#[derive(Debug, Default)]
pub(super) struct Refusals {
    entries: Vec<Undelivered>,
    /// Messages that this endpoint has refused and that no line in the log tells of yet.
    unlogged: u64,
    logged: Option<Time>,
    /// The program takes what is reported, so that no line in the log does.
    is_taken: bool,
    /// Messages that were reported and that no line in the log shows yet, with the time of the last such line.
    unshown: u64,
    shown: Option<Time>,
}

impl Refusals {
    /// The node of endpoint `own` reports this.
    pub(super) fn hear(&mut self, own: Tid, said: payload::Undelivered, now: Time) {
        for entry in said.entries {
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

    /// Logs the first report, and then one in a while, as long as the program takes none itself.
    fn show(&mut self, own: Tid, undelivered: &Undelivered, now: Time) {
        self.unshown = self.unshown.saturating_add(undelivered.count);
        if !self.is_taken && self.shown.is_none_or(|shown| now >= shown + LOG_AGAIN) {
            let messages = std::mem::take(&mut self.unshown);
            self.shown = Some(now);
            if is_of_an_end(undelivered.why) {
                crate::log::here!(info: endpoint = %own, messages, "{undelivered}");
            } else {
                crate::log::here!(warn: endpoint = %own, messages, "{undelivered}; `take_undelivered` has each of them");
            }
        }
    }

    /// This endpoint, `own`, has refused so many, and nobody was told.
    pub(super) fn count_own(&mut self, own: Tid, count: u64, now: Time) {
        if count > 0 {
            self.add(unsent(own, Rejection::QueueFull, count, now));
        }
        self.unlogged = self.unlogged.saturating_add(count);
        if self.unlogged > 0 && self.logged.is_none_or(|logged| now >= logged + LOG_AGAIN) {
            let messages = std::mem::take(&mut self.unlogged);
            self.logged = Some(now);
            crate::log::here!(warn:
                endpoint = %own,
                messages,
                "messages for it were refused: while it waited for an answer more came than it keeps; it is to receive more often"
            );
        }
    }

    /// So many more.
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

    /// The oldest.
    fn take(&mut self) -> Option<Undelivered> {
        self.is_taken = true;
        (!self.entries.is_empty()).then(|| self.entries.remove(0))
    }
}

/// Messages of which no more is known than their destination.
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
    /// Returns the next report of unconfirmed messages that were not delivered, here or by another node: one for each destination, type
    /// and reason, with the number of messages; `None` if there is nothing new. Never waits. The first refusal is reported at once, later
    /// ones every 100 ms together. A report that has not arrived when the connection ends is lost.
    ///
    /// Until the first call of this the endpoint logs a warning of reports itself, at most one every 10 s.
    ///
    /// Values of class Stream that waited for room in a direct link when that ended are counted here too, with their destination, as
    /// [`Closed`](Rejection::Closed). What lay in its ring by then, and was sent without asking for its outcome, is not: nobody knows of it.
    ///
    /// What this endpoint itself has refused without anybody's being told is counted here too, with itself as the destination.
    ///
    /// Where the outcome of one message matters, send it [confirmed](super::MessageBuilder::confirmed).
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
        // An error shows itself again when messages are received.
        let _ = self.take_in(None, WhenFull::Leave, Time::now());
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

    fn said(to: Tid, why: u8, count: u64) -> payload::Undelivered {
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
    fn what_is_said_of_one_destination_is_added_up_until_somebody_looks() {
        let mut refusals = Refusals::default();
        let full = Outcome::Rejected(Rejection::QueueFull).code();
        refusals.hear(tid(9), said(tid(1), full, 3), Time::ZERO);
        refusals.hear(tid(9), said(tid(2), full, 1), Time::ZERO);
        refusals.hear(tid(9), said(tid(1), full, 4), Time::ZERO);
        let expected = unsent(tid(1), Rejection::QueueFull, 7, Time::from_nanos(3));
        assert_eq!(refusals.take(), Some(expected), "since the first");
        assert_eq!(refusals.take().map(|undelivered| undelivered.destination), Some(tid(2)));
        assert_eq!(refusals.take(), None);
    }

    #[test]
    fn what_this_endpoint_refuses_is_counted_and_the_log_says_it_once_in_a_while() {
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
    fn nothing_that_a_node_says_makes_it_longer_than_it_may_be_and_nothing_is_uncounted() {
        let mut refusals = Refusals::default();
        for app in 0..1_000 {
            refusals.hear(tid(9), said(tid(app), (app % 256) as u8, 1), Time::ZERO);
        }
        assert!(refusals.entries.len() <= ENTRIES_MAX + 13, "{} entries", refusals.entries.len());
        assert_eq!(
            std::iter::from_fn(|| refusals.take()).map(|undelivered| undelivered.count).sum::<u64>(),
            1_000
        );
    }
}
