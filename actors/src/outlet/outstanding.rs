//! Confirmed messages that were sent and whose outcome is not known yet, by destination: who is slow takes no place of others.

use std::{
    collections::{BTreeMap, VecDeque},
    time::Duration,
};

use sinew_runtime::{
    outcome::{Outcome, Receipt, Ticket},
    tid::Tid,
    time::Time,
};

use super::{Socket, after::After, half::Half};

/// Lines that are kept though nothing is in them: most destinations are sent to again.
const EMPTY_LINES_MAX: usize = 64;

/// A message whose outcome the peer owes.
pub(super) struct Sent {
    pub(super) receipt: Receipt,
    pub(super) expiry: Time,
    /// The connection's account when it was written.
    pub(super) written: u64,
}

/// Of each destination the oldest first: outcomes come back in about this order.
#[derive(Default)]
pub(super) struct Outstanding {
    lines: BTreeMap<Tid, VecDeque<Sent>>,
    count: usize,
}

impl Outstanding {
    pub(super) fn push(&mut self, sent: Sent) {
        self.lines.entry(sent.receipt.ticket().destination).or_default().push_back(sent);
        self.count += 1;
    }

    /// All of them.
    pub(super) const fn len(&self) -> usize {
        self.count
    }

    /// Those of one destination.
    pub(super) fn of(&self, destination: Tid) -> usize {
        self.lines.get(&destination).map_or(0, VecDeque::len)
    }

    /// Takes out the one that `ticket` names.
    pub(super) fn take(&mut self, ticket: Ticket) -> Option<Receipt> {
        let lines = self.lines.len();
        let line = self.lines.get_mut(&ticket.destination)?;
        let at = line.iter().position(|sent| sent.receipt.ticket() == ticket)?;
        let sent = line.remove(at)?;
        self.count -= 1;
        if line.is_empty() && lines > EMPTY_LINES_MAX {
            self.lines.remove(&ticket.destination);
        }
        Some(sent.receipt)
    }

    /// Takes out those whose time to live was over `grace` before `now`, of each destination the oldest first. Looks at each once, however
    /// many of them go: a sender may wait for the lock.
    pub(super) fn take_overdue(&mut self, now: Time, grace: Duration) -> Vec<Receipt> {
        let mut overdue = Vec::new();
        let is_overdue = |sent: &Sent| sent.expiry != Time::MAX && now > sent.expiry + grace;
        for line in self.lines.values_mut() {
            // Nearly always there is none, and the line stays as it is.
            let Some(first) = line.iter().position(is_overdue) else { continue };
            for sent in line.split_off(first) {
                if is_overdue(&sent) {
                    overdue.push(sent.receipt);
                } else {
                    line.push_back(sent);
                }
            }
        }
        self.count -= overdue.len();
        if self.lines.len() > EMPTY_LINES_MAX {
            self.lines.retain(|_, line| !line.is_empty());
        }
        overdue
    }

    /// Takes all out.
    pub(super) fn take_all(&mut self) -> impl Iterator<Item = Sent> {
        self.count = 0;
        std::mem::take(&mut self.lines).into_values().flatten()
    }
}

impl<S: Socket> Half<S> {
    /// Settles those that were waited for, and leaves the others.
    pub(super) fn confirm_all(&mut self, outcomes: &mut Vec<(Ticket, Outcome)>, after: &mut After) {
        if self.sent_receipts.len() > 0 {
            outcomes.retain(|(ticket, outcome)| !self.confirm(*ticket, *outcome, after));
        }
    }

    pub(super) fn confirm(&mut self, ticket: Ticket, outcome: Outcome, after: &mut After) -> bool {
        let Some(receipt) = self.sent_receipts.take(ticket) else { return false };
        after.settle([(receipt, outcome)]);
        if self.unconfirmed() <= self.limits.unconfirmed_max / 2 {
            after.room.extend(self.outcomes_awaited.take());
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use std::sync::{Arc, Mutex};

    use proptest::prelude::*;
    use sinew_runtime::{
        outcome::ReceiptSink,
        tid::{AppAddress, NodeAddress},
    };

    use super::*;

    const GRACE: Duration = Duration::from_nanos(10);

    /// Whom nothing is told that any test looks at.
    #[derive(Default)]
    struct Deaf(Mutex<Vec<Ticket>>);

    impl ReceiptSink for Deaf {
        fn settle(&self, ticket: Ticket, _: Outcome) {
            self.0.lock().unwrap().push(ticket);
        }
    }

    fn tid(app: u32) -> Tid {
        Tid::new(NodeAddress::new(2), AppAddress::new(0x1000 + app))
    }

    /// Messages numbered from 0, each to one of the destinations; `None` as expiry: never.
    fn outstanding(sent: &[(u32, Option<u64>)]) -> Outstanding {
        let (mut outstanding, sink) = (Outstanding::default(), Arc::new(Deaf::default()));
        for (correlation, (to, expiry)) in (0..).zip(sent) {
            let ticket = Ticket { source: tid(0), destination: tid(*to), correlation };
            let expiry = expiry.map_or(Time::MAX, Time::from_nanos);
            outstanding.push(Sent { receipt: Receipt::new(sink.clone(), ticket), expiry, written: 0 });
        }
        outstanding
    }

    fn correlations(receipts: &[Receipt]) -> Vec<u64> {
        receipts.iter().map(|receipt| receipt.ticket().correlation).collect()
    }

    proptest! {
        #[test]
        fn what_is_overdue_goes_and_the_rest_stays_each_in_its_order(
            sent in proptest::collection::vec((0..4_u32, proptest::option::of(0..100_u64)), 0..60),
            now in 0..130_u64,
        ) {
            let mut outstanding = outstanding(&sent);
            let is_over = |expiry: Option<u64>| expiry.is_some_and(|expiry| now > expiry + 10);
            // By destination, and of each the oldest first.
            let mut all: Vec<(u32, u64, bool)> =
                (0..).zip(&sent).map(|(number, (to, expiry))| (*to, number, is_over(*expiry))).collect();
            all.sort_unstable();
            let those = |over: bool| all.iter().filter(|(.., is)| *is == over).map(|(_, number, _)| *number).collect::<Vec<_>>();
            let overdue = outstanding.take_overdue(Time::from_nanos(now), GRACE);
            prop_assert_eq!(correlations(&overdue), those(true));
            prop_assert_eq!(outstanding.len(), those(false).len());
            let left: Vec<Receipt> = outstanding.take_all().map(|sent| sent.receipt).collect();
            prop_assert_eq!(correlations(&left), those(false));
        }
    }

    #[test]
    fn destinations_that_never_answer_leave_nothing_behind() {
        let sent: Vec<_> = (0..10_000).map(|to| (to, Some(1))).collect();
        let mut outstanding = outstanding(&sent);
        assert_eq!(outstanding.take_overdue(Time::MAX, GRACE).len(), sent.len());
        assert!(outstanding.lines.len() <= EMPTY_LINES_MAX, "{} lines", outstanding.lines.len());
    }
}
