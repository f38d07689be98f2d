//! Messages that were sent without asking for their outcome, and that nobody has taken: what the node says of them.

use sinew_runtime::{
    outcome::{Outcome, Rejection},
    tid::Tid,
    time::Time,
};

use super::{Endpoint, incoming::WhenFull};
use crate::lncl::payload;

/// Destinations and reasons that are told apart at most, until the application looks. Beyond them only the reasons are.
const ENTRIES_MAX: usize = 64;

/// Messages of one endpoint to one destination that were sent without asking for their outcome, and that nobody has taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Untaken {
    /// Whom they were for; [`Tid::NONE`]: several that are not told apart any more.
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
pub(super) struct Refusals(Vec<Untaken>);

impl Refusals {
    /// The node says this.
    pub(super) fn hear(&mut self, said: &payload::Untaken) {
        for entry in &said.entries {
            // What a later node gives as a reason that this version does not know is a refusal all the same.
            let why = match Outcome::from_code(entry.why) {
                Some(Outcome::Rejected(why)) => why,
                Some(_) | None => Rejection::Unsupported,
            };
            let since = Time::from_nanos(entry.since);
            let destination = Tid::from_bits(entry.to);
            self.add(Untaken { destination, why, count: entry.count, since });
        }
    }

    fn add(&mut self, untaken: Untaken) {
        let known = self.find(untaken.destination, untaken.why);
        let is_full = self.0.len() >= ENTRIES_MAX;
        let destination = if known.is_none() && is_full { Tid::NONE } else { untaken.destination };
        match known.or_else(|| self.find(destination, untaken.why)) {
            Some(at) => self.0[at].count = self.0[at].count.saturating_add(untaken.count),
            None => self.0.push(Untaken { destination, ..untaken }),
        }
    }

    fn find(&self, destination: Tid, why: Rejection) -> Option<usize> {
        self.0.iter().position(|known| known.destination == destination && known.why == why)
    }

    /// The oldest.
    fn take(&mut self) -> Option<Untaken> {
        (!self.0.is_empty()).then(|| self.0.remove(0))
    }
}

impl Endpoint {
    /// The next thing that the node has said about messages that were sent without asking for their outcome, through the
    /// node, and that nobody has taken: once for each destination and reason, with how many; `None` if there is nothing new.
    /// Looks, and does not wait. The first refusal is told at once, those after it every 100 ms together, so that a flood
    /// of refusals wakes nobody for each. What is not told when the connection ends is not told.
    ///
    /// Whoever needs to know it of one message sends that one [confirmed](Self::send_confirmed).
    pub fn untaken(&mut self) -> Option<Untaken> {
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

    fn said(to: Tid, why: u8, count: u64) -> payload::Untaken {
        payload::Untaken { entries: vec![payload::UntakenEntry { to: to.bits(), why, count, since: count }] }
    }

    #[test]
    fn what_is_said_of_one_destination_is_added_up_until_somebody_looks() {
        let mut refusals = Refusals::default();
        let full = Outcome::Rejected(Rejection::QueueFull).code();
        refusals.hear(&said(tid(1), full, 3));
        refusals.hear(&said(tid(2), full, 1));
        refusals.hear(&said(tid(1), full, 4));
        let expected =
            Untaken { destination: tid(1), why: Rejection::QueueFull, count: 7, since: Time::from_nanos(3) };
        assert_eq!(refusals.take(), Some(expected), "since the first");
        assert_eq!(refusals.take().map(|untaken| untaken.destination), Some(tid(2)));
        assert_eq!(refusals.take(), None);
    }

    #[test]
    fn nothing_that_a_node_says_makes_it_longer_than_it_may_be_and_nothing_is_uncounted() {
        let mut refusals = Refusals::default();
        for app in 0..1_000 {
            refusals.hear(&said(tid(app), (app % 256) as u8, 1));
        }
        assert!(refusals.0.len() <= ENTRIES_MAX + 11, "{} entries", refusals.0.len());
        assert_eq!(std::iter::from_fn(|| refusals.take()).map(|untaken| untaken.count).sum::<u64>(), 1_000);
    }
}
