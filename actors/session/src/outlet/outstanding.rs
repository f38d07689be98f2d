//! Confirmed messages without a known outcome, by destination, and their bounds: a slow destination takes no
//! place of others.
//!
//! They have a separate lock. No thread writes or waits while it holds this lock. Outcomes are settled, and
//! overdue ones given up, while another thread writes to the connection, however long that takes. A thread
//! may take this lock while it holds the outlet's lock, never the other way round.

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
    WakerList,
    outcome::{Outcome, Receipt, Ticket},
    tid::Tid,
    time::Time,
    wire::Message,
};

use super::{OutcomeRun, OutletLimits, deferred::DeferredActions, numbering::Session};

/// Time after a sent message's time to live in which its outcome may still arrive.
pub(super) const OUTCOME_GRACE: Duration = Duration::from_secs(1);
/// With a session, the bound for all destinations is this multiple of the bound for one.
const UNCONFIRMED_DESTINATIONS: usize = 8;
/// Maximum number of empty destinations that are kept, because most destinations are used again.
const EMPTY_DESTINATIONS_MAX: usize = 64;

/// Returns the destination that must report the outcome of a message; `None` if none must.
pub(super) fn confirming_destination(message: &Message) -> Option<Tid> {
    message.receipt.as_ref().map(|receipt| receipt.ticket().destination)
}

/// A sent message with a pending outcome.
pub(super) struct SentMessage {
    pub(super) receipt: Receipt,
    pub(super) expiry: Time,
    /// The connection's count of written bytes after this message.
    pub(super) written: u64,
}

/// The pending outcomes of one destination.
#[derive(Default)]
struct Destination {
    /// Sent messages, the oldest first: outcomes arrive in about this order.
    sent: VecDeque<SentMessage>,
    /// Messages that wait to be sent, in the queue or in the backlog.
    waiting: usize,
}

impl Destination {
    fn is_empty(&self) -> bool {
        self.sent.is_empty() && self.waiting == 0
    }
}

/// Bounds on the number of pending outcomes.
#[derive(Clone, Copy, Debug)]
pub(super) struct Shares {
    unconfirmed_max: usize,
    /// The number of outcomes that the peer has room for; `None` without a session.
    outcome_room: Option<usize>,
}

impl Shares {
    pub(super) fn of(limits: OutletLimits, session: Option<&Session>) -> Self {
        let outcome_room = session.map(|session| session.outcome_room);
        Self { unconfirmed_max: limits.unconfirmed_max, outcome_room }
    }
}

/// Confirmed messages and their lock. A queued one stays until it is sent or dropped, a sent one until its
/// outcome is known.
pub(super) struct Open {
    all: Mutex<Outstanding>,
    /// The number of these messages.
    count: AtomicUsize,
    /// While there are fewer, no destination is at its bound.
    always_open: usize,
}

impl Open {
    pub(super) fn new(shares: Shares) -> Self {
        let all = Outstanding::new(shares);
        let always_open = all.share_of_one().min(all.room_for_all());
        Self { all: Mutex::new(all), count: AtomicUsize::new(0), always_open }
    }

    /// Calls the method of this name of [`Outstanding`], as do the following methods.
    #[inline]
    pub(super) fn add_waiting(&self, confirming_destination: Option<Tid>) {
        if confirming_destination.is_some() {
            self.with(|all| all.add_waiting(confirming_destination));
        }
    }

    pub(super) fn remove_waiting(&self, confirming_destination: Option<Tid>) {
        if confirming_destination.is_some() {
            self.with(|all| all.remove_waiting(confirming_destination));
        }
    }

    pub(super) fn clear_waiting(&self) {
        self.with(Outstanding::clear_waiting);
    }

    pub(super) fn begin_write(&self, ticket: Ticket) {
        self.with(|all| all.writing = Some((ticket, None)));
    }

    pub(super) fn end_write(&self) {
        self.with(|all| all.writing = None);
    }

    pub(super) fn sent(&self, sent: SentMessage) -> Option<(Receipt, Outcome)> {
        self.with(|all| all.sent(sent))
    }

    pub(super) fn take_all(&self) -> std::vec::IntoIter<SentMessage> {
        self.with(Outstanding::take_all)
    }

    /// Settles the message that `ticket` names. Returns whether it was pending.
    pub(super) fn confirm(&self, ticket: Ticket, outcome: Outcome, deferred: &mut DeferredActions) -> bool {
        let mut run = OutcomeRun::new(ticket, 1, outcome);
        self.with(|all| all.confirm(&mut run, deferred));
        run.is_empty()
    }

    /// Settles the outcomes that were pending, and leaves the runs with others in `outcomes`.
    pub(super) fn confirm_all(&self, outcomes: &mut Vec<OutcomeRun>, deferred: &mut DeferredActions) {
        if self.len() > 0 {
            self.with(|all| all.confirm_all(outcomes, deferred));
        }
    }

    /// Gives up outcomes that are `grace` overdue, to free their places. By then the senders have stopped
    /// waiting.
    pub(super) fn give_up_overdue(&self, now: Time, grace: Duration, deferred: &mut DeferredActions) {
        if self.len() > 0 {
            self.with(|all| {
                let overdue = all.take_overdue(now, grace);
                deferred.settle(overdue.into_iter().map(|receipt| (receipt, Outcome::Unknown)));
                all.wake_if_fewer_open(deferred);
            });
        }
    }

    pub(super) fn wake_if_fewer_open(&self, deferred: &mut DeferredActions) {
        self.with(|all| all.wake_if_fewer_open(deferred));
    }

    /// Whether this destination can have no further message. Only the thread with the outlet's lock adds messages, so
    /// that others can only make the answer `false`. Most often it needs no lock.
    pub(super) fn is_at_bound(&self, destination: Tid) -> bool {
        self.len() >= self.always_open && self.with(|all| all.is_at_bound(destination))
    }

    /// Registers a sender that found too many pending outcomes of this destination. It is woken when there
    /// are [fewer](Self::wake_if_fewer_open). Returns whether there still are too many.
    pub(super) fn await_fewer(&self, destination: Tid, room: &Waker, deferred: &mut DeferredActions) -> bool {
        self.with(|all| {
            let is_at_bound = all.is_at_bound(destination);
            if is_at_bound {
                if all.awaited.len() >= WakerList::MAX && !all.awaited.contains_key(&destination) {
                    // Most of these wait no more; the others offer their messages again.
                    deferred.room.extend(all.take_awaited());
                }
                deferred.room.extend(all.awaited.entry(destination).or_default().add(room));
            }
            is_at_bound
        })
    }

    /// Takes the wakers of the senders that waited for fewer pending outcomes; the caller must wake them.
    pub(super) fn awaited_no_more(&self) -> Vec<Waker> {
        self.with(Outstanding::take_awaited)
    }

    /// Returns the number of all messages, queued or sent.
    pub(super) fn len(&self) -> usize {
        // SYNC: Acquire, with the Release below. A message is counted before it is written, so a thread that
        // has its outcome from the peer sees the count.
        self.count.load(Ordering::Acquire)
    }

    /// Runs `step` under the lock. No step can panic halfway.
    fn with<R>(&self, step: impl FnOnce(&mut Outstanding) -> R) -> R {
        let all = &mut *self.all.lock().unwrap_or_else(PoisonError::into_inner);
        let result = step(all);
        // SYNC: see `len`.
        self.count.store(all.open(), Ordering::Release);
        result
    }
}

/// The state under that lock.
struct Outstanding {
    shares: Shares,
    destinations: BTreeMap<Tid, Destination>,
    sent: usize,
    waiting: usize,
    /// The message that is being written, and its outcome if that arrived before the write returned.
    writing: Option<(Ticket, Option<Outcome>)>,
    /// The senders that wait for fewer pending outcomes, by their destination.
    awaited: BTreeMap<Tid, WakerList>,
}

impl Outstanding {
    const fn new(shares: Shares) -> Self {
        Self {
            shares,
            destinations: BTreeMap::new(),
            sent: 0,
            waiting: 0,
            writing: None,
            awaited: BTreeMap::new(),
        }
    }

    /// Counts a queued message of this destination with a pending outcome. Does nothing for `None`.
    fn add_waiting(&mut self, confirming_destination: Option<Tid>) {
        let Some(destination) = confirming_destination else { return };
        self.destinations.entry(destination).or_default().waiting += 1;
        self.waiting += 1;
    }

    /// Removes a message counted by [`add_waiting`](Self::add_waiting) that will not be sent.
    fn remove_waiting(&mut self, confirming_destination: Option<Tid>) {
        let Some(destination) = confirming_destination else { return };
        let count = self.destinations.len();
        let Some(pending) = self.destinations.get_mut(&destination) else { return };
        pending.waiting -= 1;
        self.waiting -= 1;
        if pending.is_empty() && count > EMPTY_DESTINATIONS_MAX {
            self.destinations.remove(&destination);
        }
    }

    /// Removes all queued messages, which will not be sent.
    fn clear_waiting(&mut self) {
        self.destinations.values_mut().for_each(|pending| pending.waiting = 0);
        self.waiting = 0;
    }

    /// Moves a message counted by [`add_waiting`](Self::add_waiting) to the sent ones. Returns its outcome if
    /// the peer has already reported it.
    fn sent(&mut self, sent: SentMessage) -> Option<(Receipt, Outcome)> {
        let ticket = sent.receipt.ticket();
        let reported =
            self.writing.take().filter(|(writing, _)| *writing == ticket).and_then(|(_, reported)| reported);
        if let Some(outcome) = reported {
            self.remove_waiting(Some(ticket.destination));
            return Some((sent.receipt, outcome));
        }
        let pending = self.destinations.entry(ticket.destination).or_default();
        pending.waiting -= 1;
        pending.sent.push_back(sent);
        self.waiting -= 1;
        self.sent += 1;
        None
    }

    /// Returns the number of all messages, queued or sent.
    const fn open(&self) -> usize {
        self.sent + self.waiting
    }

    /// Returns the numbers of sent and of queued messages of one destination.
    fn of(&self, destination: Tid) -> (usize, usize) {
        self.destinations.get(&destination).map_or((0, 0), |pending| (pending.sent.len(), pending.waiting))
    }

    /// Removes sent messages that expired more than `grace` before `now`, the oldest first per destination.
    /// Visits each message once, however many are removed, because a sender may wait for the lock.
    fn take_overdue(&mut self, now: Time, grace: Duration) -> Vec<Receipt> {
        let mut overdue = Vec::new();
        let is_overdue = |sent: &SentMessage| sent.expiry != Time::MAX && now > sent.expiry + grace;
        for pending in self.destinations.values_mut() {
            // There is nearly always none, and the entry stays unchanged.
            let Some(first) = pending.sent.iter().position(is_overdue) else { continue };
            for sent in pending.sent.split_off(first) {
                if is_overdue(&sent) {
                    overdue.push(sent.receipt);
                } else {
                    pending.sent.push_back(sent);
                }
            }
        }
        self.sent -= overdue.len();
        if self.destinations.len() > EMPTY_DESTINATIONS_MAX {
            self.destinations.retain(|_, pending| !pending.is_empty());
        }
        overdue
    }

    /// Removes all sent messages.
    fn take_all(&mut self) -> std::vec::IntoIter<SentMessage> {
        let mut all = Vec::with_capacity(self.sent);
        self.destinations.values_mut().for_each(|pending| all.extend(pending.sent.drain(..)));
        self.destinations.retain(|_, pending| !pending.is_empty());
        self.sent = 0;
        all.into_iter()
    }

    /// Settles the messages with a reported outcome, and keeps the runs with others.
    fn confirm_all(&mut self, outcomes: &mut Vec<OutcomeRun>, deferred: &mut DeferredActions) {
        outcomes.retain_mut(|run| {
            self.confirm(run, deferred);
            !run.is_empty()
        });
    }

    /// Settles the messages of a run that are pending.
    fn confirm(&mut self, run: &mut OutcomeRun, deferred: &mut DeferredActions) {
        self.settle_sent(run, deferred);
        // The outcome arrived before the write returned: the writing thread settles it.
        if let Some((writing, reported)) = &mut self.writing
            && reported.is_none()
            && run.settle(*writing)
        {
            *reported = Some(run.outcome());
        }
    }

    /// Settles the sent messages of a run, in the order in which they were sent. Visits each message of the destination
    /// at most once. The outcomes of a flood come in this order, so that its first message is the oldest one.
    fn settle_sent(&mut self, run: &mut OutcomeRun, deferred: &mut DeferredActions) {
        let (count, destination) = (self.destinations.len(), run.destination());
        let Some(pending) = self.destinations.get_mut(&destination) else { return };
        let (before, mut at) = (pending.sent.len(), 0);
        while !run.is_empty() {
            let mut next = pending.sent.range(at..);
            let Some(skipped) = next.position(|sent| run.settle(sent.receipt.ticket())) else { break };
            at += skipped;
            deferred.settle(pending.sent.remove(at).map(|sent| (sent.receipt, run.outcome())));
        }
        let settled = before - pending.sent.len();
        if settled == 0 {
            return;
        }
        self.sent -= settled;
        if pending.is_empty() && count > EMPTY_DESTINATIONS_MAX {
            self.destinations.remove(&destination);
        }
        self.wake_if_fewer_open(deferred);
    }

    fn take_awaited(&mut self) -> Vec<Waker> {
        std::mem::take(&mut self.awaited).into_values().flat_map(|mut waiting| waiting.take()).collect()
    }

    /// Wakes the waiting senders of each destination that has room for half of its share. Other destinations may
    /// stay at their bound forever.
    fn wake_if_fewer_open(&mut self, deferred: &mut DeferredActions) {
        if self.awaited.is_empty() || self.room_for_all() == 0 {
            return;
        }
        let mut awaited = std::mem::take(&mut self.awaited);
        awaited.retain(|destination, waiting| {
            let stays = 2 * self.room_for(*destination) < self.share_of_one();
            if !stays {
                deferred.room.extend(waiting.take());
            }
            stays
        });
        self.awaited = awaited;
    }

    /// Whether the destination or all destinations together are at their bound. With a session, each
    /// destination has the bound, and all together have a multiple of it, limited by the peer's room for
    /// outcomes. A destination that reports nothing for long therefore does not block others.
    fn is_at_bound(&self, destination: Tid) -> bool {
        self.room_for_all() == 0 || self.room_for(destination) == 0
    }

    /// Returns how many more outcomes may be pending in total. Without a session, each destination's bound is
    /// also the bound of all.
    fn room_for_all(&self) -> usize {
        let bound = UNCONFIRMED_DESTINATIONS.saturating_mul(self.shares.unconfirmed_max);
        let bound = self.shares.outcome_room.map_or(usize::MAX, |there| bound.min(there));
        bound.saturating_sub(self.open())
    }

    /// Returns the share of one destination: of the peer's room for outcomes no larger a part than of the
    /// bound for all.
    fn share_of_one(&self) -> usize {
        let outcome_room = self.shares.outcome_room.unwrap_or(usize::MAX);
        self.shares.unconfirmed_max.min((outcome_room / UNCONFIRMED_DESTINATIONS).max(1))
    }

    /// Returns how many more outcomes of this destination may be pending.
    fn room_for(&self, destination: Tid) -> usize {
        let (bound, share) = (self.shares.unconfirmed_max, self.share_of_one());
        if self.shares.outcome_room.is_none() {
            return bound.saturating_sub(self.open());
        }
        let (sent, waiting) = self.of(destination);
        // The queue and the pending bound the queued messages, and the bound for all is a multiple of these.
        // If the peer has less room, the queued messages of one destination alone could use all of it.
        let open = if share < bound { sent + waiting } else { sent };
        share.saturating_sub(open)
    }
}

#[cfg(test)]
mod tests;
