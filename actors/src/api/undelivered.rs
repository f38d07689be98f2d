//! Messages that were sent without asking for their outcome, and that nobody has taken: what the node says of them, and this endpoint.

use std::time::Duration;

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    tid::Tid,
    time::Time,
};

use super::{Endpoint, incoming::WhenFull};
use crate::lncl::payload;

/// Destinations and reasons that are told apart at most, until the application looks. Beyond them only the reasons are.
const ENTRIES_MAX: usize = 64;
/// Time between two lines in the log about messages that this endpoint has refused.
const LOG_AGAIN: Duration = Duration::from_secs(10);

/// Messages of one endpoint to one destination that were sent without asking for their outcome, and that nobody has taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Undelivered {
    /// Whom they were for; [`Tid::NONE`]: several that are not told apart any more. This endpoint itself, too: what others
    /// have sent to it, or to a group of its, and it had no room for while it waited for an answer.
    pub destination: Tid,
    /// Why: mostly [`Rejection::QueueFull`], that is more came than the destination takes.
    pub why: Rejection,
    /// How many, since the last time that this endpoint said so. Never 0.
    pub count: u64,
    /// When the first of these was refused, on this host's monotonic clock.
    pub since: Time,
}

/// What the node has said, until the application looks.
#[derive(Debug, Default)]
pub(super) struct Refusals {
    entries: Vec<Undelivered>,
    /// Messages that this endpoint has refused and that no line in the log tells of yet.
    unlogged: u64,
    logged: Option<Time>,
}

impl Refusals {
    /// The node says this.
    pub(super) fn hear(&mut self, said: &payload::Undelivered) {
        for entry in &said.entries {
            // What a later node gives as a reason that this version does not know is a refusal all the same.
            let why = match Outcome::from_code(entry.why) {
                Some(Outcome::Rejected(why)) => why,
                Some(_) | None => Rejection::Unsupported,
            };
            let since = Time::from_nanos(entry.since);
            let destination = Tid::from_bits(entry.to);
            self.add(Undelivered { destination, why, count: entry.count, since });
        }
    }

    /// This endpoint, `own`, has refused so many, and nobody was told.
    pub(super) fn count_own(&mut self, own: Tid, count: u64, now: Time) {
        if count > 0 {
            self.add(Undelivered { destination: own, why: Rejection::QueueFull, count, since: now });
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
        let known = self.find(undelivered.destination, undelivered.why);
        let is_full = self.entries.len() >= ENTRIES_MAX;
        let destination = if known.is_none() && is_full { Tid::NONE } else { undelivered.destination };
        match known.or_else(|| self.find(destination, undelivered.why)) {
            Some(at) => self.entries[at].count = self.entries[at].count.saturating_add(undelivered.count),
            None => self.entries.push(Undelivered { destination, ..undelivered }),
        }
    }

    fn find(&self, destination: Tid, why: Rejection) -> Option<usize> {
        self.entries.iter().position(|known| known.destination == destination && known.why == why)
    }

    /// The oldest.
    fn take(&mut self) -> Option<Undelivered> {
        (!self.entries.is_empty()).then(|| self.entries.remove(0))
    }
}

impl Endpoint {
    /// The next thing that the node has said about messages that were sent without asking for their outcome, through the
    /// node, and that nobody has taken: once for each destination and reason, with how many; `None` if there is nothing new.
    /// Looks, and does not wait. The first refusal is told at once, those after it every 100 ms together, so that a flood
    /// of refusals wakes nobody for each. What is not told when the connection ends is not told.
    ///
    /// Values of class Stream that waited for room in a direct link when that ended are counted here too, with their destination, as
    /// [`Closed`](Rejection::Closed). What lay in its ring by then, and was sent without asking for its outcome, is not: nobody knows of it.
    ///
    /// What this endpoint itself has refused without anybody's being told is counted here too, with itself as the destination.
    ///
    /// Whoever needs to know it of one message sends that one [confirmed](super::MessageBuilder::confirmed).
    pub fn take_undelivered(&mut self) -> Option<Undelivered> {
        // An error shows itself again when messages are received.
        let _ = self.take_in(None, WhenFull::Leave, Time::now());
        self.refusals.take()
    }
}

#[cfg(test)]
mod tests {
    use sinew_runtime::tid::{AppAddress, NodeAddress};

    use super::*;

    fn tid(app: u32) -> Tid {
        Tid::new(NodeAddress::new(1), AppAddress::new(app))
    }

    fn said(to: Tid, why: u8, count: u64) -> payload::Undelivered {
        payload::Undelivered {
            entries: vec![payload::UndeliveredEntry { to: to.bits(), why, count, since: count }],
        }
    }

    #[test]
    fn what_is_said_of_one_destination_is_added_up_until_somebody_looks() {
        let mut refusals = Refusals::default();
        let full = Outcome::Rejected(Rejection::QueueFull).code();
        refusals.hear(&said(tid(1), full, 3));
        refusals.hear(&said(tid(2), full, 1));
        refusals.hear(&said(tid(1), full, 4));
        let expected = Undelivered {
            destination: tid(1),
            why: Rejection::QueueFull,
            count: 7,
            since: Time::from_nanos(3),
        };
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
        let expected = Undelivered { destination: tid(1), why: Rejection::QueueFull, count: 7, since: at(2) };
        assert_eq!((refusals.take(), refusals.take()), (Some(expected), None));
    }

    #[test]
    fn nothing_that_a_node_says_makes_it_longer_than_it_may_be_and_nothing_is_uncounted() {
        let mut refusals = Refusals::default();
        for app in 0..1_000 {
            refusals.hear(&said(tid(app), (app % 256) as u8, 1));
        }
        assert!(refusals.entries.len() <= ENTRIES_MAX + 12, "{} entries", refusals.entries.len());
        assert_eq!(
            std::iter::from_fn(|| refusals.take()).map(|undelivered| undelivered.count).sum::<u64>(),
            1_000
        );
    }
}
