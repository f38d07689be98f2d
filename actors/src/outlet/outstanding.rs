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

    /// Takes out those whose time to live was over `grace` before `now`.
    pub(super) fn take_overdue(&mut self, now: Time, grace: Duration) -> Vec<Receipt> {
        let mut overdue = Vec::new();
        let is_overdue = |sent: &Sent| sent.expiry != Time::MAX && now > sent.expiry + grace;
        for line in self.lines.values_mut() {
            while let Some(sent) = line.iter().position(is_overdue).and_then(|at| line.remove(at)) {
                overdue.push(sent.receipt);
            }
        }
        self.count -= overdue.len();
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
