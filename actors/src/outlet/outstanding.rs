//! Confirmed messages whose outcome is not known yet, by destination, and how many there may be: who is slow takes no place of others.
//!
//! They have a lock of their own, under which nothing is written or waited for: an outcome is told, and one that does not come is given up,
//! whoever writes to the connection meanwhile, and for however long the system lets him. It may be taken with the outlet's in hand, never the
//! other way round.

use std::{
    collections::{BTreeMap, VecDeque},
    sync::{
        Mutex, PoisonError,
        atomic::{AtomicUsize, Ordering},
    },
    task::Waker,
    time::Duration,
};

use sinew_runtime::{
    outcome::{Outcome, Receipt, Ticket},
    tid::Tid,
    time::Time,
    wire::Message,
};

use super::{OutletLimits, after::After, resume::Session};

/// Of a session: times the bound for one destination, so many messages may be unconfirmed for all.
const UNCONFIRMED_DESTINATIONS: usize = 8;
/// Lines that are kept though nothing is in them: most destinations are sent to again.
const EMPTY_LINES_MAX: usize = 64;

/// Who owes the outcome of a message; `None` if nobody does.
pub(super) fn owed_by(message: &Message) -> Option<Tid> {
    message.receipt.as_ref().map(|receipt| receipt.ticket().destination)
}

/// A message whose outcome the peer owes.
pub(super) struct Sent {
    pub(super) receipt: Receipt,
    pub(super) expiry: Time,
    /// The connection's account when it was written.
    pub(super) written: u64,
}

/// What one destination owes.
#[derive(Default)]
struct Line {
    /// The oldest first: outcomes come back in about this order.
    sent: VecDeque<Sent>,
    /// How many wait to be sent, wherever they do.
    waiting: usize,
}

impl Line {
    fn is_empty(&self) -> bool {
        self.sent.is_empty() && self.waiting == 0
    }
}

/// Of how many the outcome may be open.
#[derive(Clone, Copy, Debug)]
pub(super) struct Shares {
    unconfirmed_max: usize,
    /// For how many outcomes the peer has room; `None` without a session.
    answers_there: Option<usize>,
}

impl Shares {
    pub(super) fn of(limits: OutletLimits, session: Option<&Session>) -> Self {
        let answers_there = session.map(|session| session.answers_there);
        Self { unconfirmed_max: limits.unconfirmed_max, answers_there }
    }
}

/// Each that waits, until it is sent or given up, and each that was sent, until its outcome is known; and its lock.
pub(super) struct Open {
    all: Mutex<Outstanding>,
    /// How many they are.
    count: AtomicUsize,
}

impl Open {
    pub(super) fn new(shares: Shares) -> Self {
        Self { all: Mutex::new(Outstanding::new(shares)), count: AtomicUsize::new(0) }
    }

    /// See [`Outstanding`], of all of these.
    pub(super) fn waits(&self, owed_by: Option<Tid>) {
        if owed_by.is_some() {
            self.with(|all| all.waits(owed_by));
        }
    }

    pub(super) fn waits_no_more(&self, owed_by: Option<Tid>) {
        if owed_by.is_some() {
            self.with(|all| all.waits_no_more(owed_by));
        }
    }

    pub(super) fn none_waits(&self) {
        self.with(Outstanding::none_waits);
    }

    pub(super) fn writes(&self, ticket: Ticket) {
        self.with(|all| all.writing = Some((ticket, None)));
    }

    pub(super) fn writes_no_more(&self) {
        self.with(|all| all.writing = None);
    }

    pub(super) fn sent(&self, sent: Sent) -> Option<(Receipt, Outcome)> {
        self.with(|all| all.sent(sent))
    }

    pub(super) fn take_all(&self) -> std::vec::IntoIter<Sent> {
        self.with(Outstanding::take_all)
    }

    pub(super) fn confirm(&self, ticket: Ticket, outcome: Outcome, after: &mut After) -> bool {
        self.with(|all| all.confirm(ticket, outcome, after))
    }

    /// Settles those that were waited for, and leaves the others.
    pub(super) fn confirm_all(&self, outcomes: &mut Vec<(Ticket, Outcome)>, after: &mut After) {
        if self.len() > 0 {
            self.with(|all| outcomes.retain(|(ticket, outcome)| !all.confirm(*ticket, *outcome, after)));
        }
    }

    /// Outcomes that are `grace` overdue do not come any more; their places are needed. By then the senders have stopped waiting.
    pub(super) fn give_up_overdue(&self, now: Time, grace: Duration, after: &mut After) {
        if self.len() > 0 {
            self.with(|all| {
                let overdue = all.take_overdue(now, grace);
                after.settle(overdue.into_iter().map(|receipt| (receipt, Outcome::Unknown)));
                all.fewer_are_open(after);
            });
        }
    }

    pub(super) fn fewer_are_open(&self, after: &mut After) {
        self.with(|all| all.fewer_are_open(after));
    }

    pub(super) fn has_too_many(&self, destination: Tid) -> bool {
        self.with(|all| all.has_too_many(destination))
    }

    /// Whoever has found that there are too many of this destination is woken when there are [fewer](Self::fewer_are_open). Returns whether there
    /// still are too many.
    pub(super) fn await_fewer(&self, destination: Tid, room: Option<&Waker>) -> bool {
        self.with(|all| {
            let has_too_many = all.has_too_many(destination);
            if has_too_many {
                all.awaited = room.map(|room| (destination, room.clone()));
            }
            has_too_many
        })
    }

    /// Nobody waits any more until there are fewer: who did is to be woken.
    pub(super) fn awaited_no_more(&self) -> Option<Waker> {
        self.with(|all| all.awaited.take().map(|(_, waker)| waker))
    }

    /// All that were sent or wait.
    pub(super) fn len(&self) -> usize {
        // SYNC: Acquire, with the Release below. A message counts before it is written, so whoever has its outcome from the peer sees it.
        self.count.load(Ordering::Acquire)
    }

    /// Nothing under this lock can panic half way.
    fn with<R>(&self, step: impl FnOnce(&mut Outstanding) -> R) -> R {
        let all = &mut *self.all.lock().unwrap_or_else(PoisonError::into_inner);
        let result = step(all);
        // SYNC: see `len`.
        self.count.store(all.open(), Ordering::Release);
        result
    }
}

/// What stands under that lock.
struct Outstanding {
    shares: Shares,
    lines: BTreeMap<Tid, Line>,
    sent: usize,
    waiting: usize,
    /// The message that is being written, and what the peer has said of it before the write has returned.
    writing: Option<(Ticket, Option<Outcome>)>,
    /// Who waits until fewer of them are open, and for which destination.
    awaited: Option<(Tid, Waker)>,
}

impl Outstanding {
    const fn new(shares: Shares) -> Self {
        Self { shares, lines: BTreeMap::new(), sent: 0, waiting: 0, writing: None, awaited: None }
    }

    /// A message that this destination owes the outcome of waits to be sent; nothing, if nobody owes one.
    fn waits(&mut self, owed_by: Option<Tid>) {
        let Some(destination) = owed_by else { return };
        self.lines.entry(destination).or_default().waiting += 1;
        self.waiting += 1;
    }

    /// One that [waited](Self::waits) is not going to be sent.
    fn waits_no_more(&mut self, owed_by: Option<Tid>) {
        let Some(destination) = owed_by else { return };
        let lines = self.lines.len();
        let Some(line) = self.lines.get_mut(&destination) else { return };
        line.waiting -= 1;
        self.waiting -= 1;
        if line.is_empty() && lines > EMPTY_LINES_MAX {
            self.lines.remove(&destination);
        }
    }

    /// All that waited are not going to be sent.
    fn none_waits(&mut self) {
        self.lines.values_mut().for_each(|line| line.waiting = 0);
        self.waiting = 0;
    }

    /// One that [waited](Self::waits) was sent. Returns what the peer has said of it already.
    fn sent(&mut self, sent: Sent) -> Option<(Receipt, Outcome)> {
        let ticket = sent.receipt.ticket();
        let said = self.writing.take().filter(|(writing, _)| *writing == ticket).and_then(|(_, said)| said);
        if let Some(outcome) = said {
            self.waits_no_more(Some(ticket.destination));
            return Some((sent.receipt, outcome));
        }
        let line = self.lines.entry(ticket.destination).or_default();
        line.waiting -= 1;
        line.sent.push_back(sent);
        self.waiting -= 1;
        self.sent += 1;
        None
    }

    /// All that were sent or wait.
    const fn open(&self) -> usize {
        self.sent + self.waiting
    }

    /// Those of one destination that were sent, and those that wait.
    fn of(&self, destination: Tid) -> (usize, usize) {
        self.lines.get(&destination).map_or((0, 0), |line| (line.sent.len(), line.waiting))
    }

    /// Takes out the one that `ticket` names.
    fn take(&mut self, ticket: Ticket) -> Option<Receipt> {
        let lines = self.lines.len();
        let line = self.lines.get_mut(&ticket.destination)?;
        let at = line.sent.iter().position(|sent| sent.receipt.ticket() == ticket)?;
        let sent = line.sent.remove(at)?;
        self.sent -= 1;
        if line.is_empty() && lines > EMPTY_LINES_MAX {
            self.lines.remove(&ticket.destination);
        }
        Some(sent.receipt)
    }

    /// Takes out those whose time to live was over `grace` before `now`, of each destination the oldest first. Looks at each once, however
    /// many of them go: a sender may wait for the lock.
    fn take_overdue(&mut self, now: Time, grace: Duration) -> Vec<Receipt> {
        let mut overdue = Vec::new();
        let is_overdue = |sent: &Sent| sent.expiry != Time::MAX && now > sent.expiry + grace;
        for line in self.lines.values_mut() {
            // Nearly always there is none, and the line stays as it is.
            let Some(first) = line.sent.iter().position(is_overdue) else { continue };
            for sent in line.sent.split_off(first) {
                if is_overdue(&sent) {
                    overdue.push(sent.receipt);
                } else {
                    line.sent.push_back(sent);
                }
            }
        }
        self.sent -= overdue.len();
        if self.lines.len() > EMPTY_LINES_MAX {
            self.lines.retain(|_, line| !line.is_empty());
        }
        overdue
    }

    /// Takes all out that were sent.
    fn take_all(&mut self) -> std::vec::IntoIter<Sent> {
        let mut all = Vec::with_capacity(self.sent);
        self.lines.values_mut().for_each(|line| all.extend(line.sent.drain(..)));
        self.lines.retain(|_, line| !line.is_empty());
        self.sent = 0;
        all.into_iter()
    }

    /// Returns whether that one was waited for.
    fn confirm(&mut self, ticket: Ticket, outcome: Outcome, after: &mut After) -> bool {
        if let Some(receipt) = self.take(ticket) {
            after.settle([(receipt, outcome)]);
            self.fewer_are_open(after);
            return true;
        }
        match &mut self.writing {
            // The peer was faster than the write's return: whoever writes settles it.
            Some((writing, said @ None)) if *writing == ticket => {
                *said = Some(outcome);
                true
            }
            Some(_) | None => false,
        }
    }

    /// Whoever waits for that is woken, once its destination has room for half of what it may have: others may owe all they can for ever.
    fn fewer_are_open(&mut self, after: &mut After) {
        let Some((destination, _)) = &self.awaited else { return };
        if self.left_for_all() > 0 && 2 * self.left_for(*destination) >= self.share_of_one() {
            after.room.extend(self.awaited.take().map(|(_, waker)| waker));
        }
    }

    /// Where there is a session, a destination may have as many as the bound says, and all together a few times that, as far as the peer
    /// has room for their outcomes: one that says nothing for long stops nobody else.
    fn has_too_many(&self, destination: Tid) -> bool {
        self.left_for_all() == 0 || self.left_for(destination) == 0
    }

    /// How many more may be open, whoever owes them. Without a session each destination's bound is that of all.
    fn left_for_all(&self) -> usize {
        let bound = UNCONFIRMED_DESTINATIONS * self.shares.unconfirmed_max;
        let bound = self.shares.answers_there.map_or(usize::MAX, |there| bound.min(there));
        bound.saturating_sub(self.open())
    }

    /// How many one destination may have open: of the room that the peer has for outcomes no larger part than of the bound for all.
    fn share_of_one(&self) -> usize {
        let answers_there = self.shares.answers_there.unwrap_or(usize::MAX);
        self.shares.unconfirmed_max.min((answers_there / UNCONFIRMED_DESTINATIONS).max(1))
    }

    /// How many more of this destination may be open.
    fn left_for(&self, destination: Tid) -> usize {
        let (bound, share) = (self.shares.unconfirmed_max, self.share_of_one());
        if self.shares.answers_there.is_none() {
            return bound.saturating_sub(self.open());
        }
        let (sent, waiting) = self.of(destination);
        // What waits is bounded by the queue and by its line, and the bound for all is a few times that. Where the peer has less room, what
        // waits for one destination alone could take all of it.
        let open = if share < bound { sent + waiting } else { sent };
        share.saturating_sub(open)
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
        let shares = Shares { unconfirmed_max: usize::MAX / UNCONFIRMED_DESTINATIONS, answers_there: None };
        let (mut outstanding, sink) = (Outstanding::new(shares), Arc::new(Deaf::default()));
        for (correlation, (to, expiry)) in (0..).zip(sent) {
            let ticket = Ticket { source: tid(0), destination: tid(*to), correlation };
            let expiry = expiry.map_or(Time::MAX, Time::from_nanos);
            outstanding.waits(Some(ticket.destination));
            let sent = Sent { receipt: Receipt::new(sink.clone(), ticket), expiry, written: 0 };
            assert!(outstanding.sent(sent).is_none(), "nothing was said of it");
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
            prop_assert_eq!(outstanding.open(), those(false).len());
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
