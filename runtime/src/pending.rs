//! The pending waits of an application: outcomes of its confirmed messages and replies to its requests.

use std::{
    collections::{HashMap, VecDeque, hash_map::Entry},
    hash::{BuildHasherDefault, Hasher},
    sync::{
        Arc, Mutex,
        atomic::{AtomicBool, Ordering},
    },
    task::{Context, Poll, Waker},
};

use crate::{
    clock::Clock,
    lock,
    outcome::{self, MemberOutcome, MemberReport, MemberTable, Outcome, ReceiptSink, Ticket},
    router::{MessageSink, SubmitError},
    tid::{NodeAddress, Tid},
    time::Time,
    wakes,
    wire::{Flags, Header, Kind, Message},
};

/// Maximum number of recorded cancellations of requests to one application. Beyond it the oldest is removed,
/// and only the deadline of that request shows that it is no longer awaited.
const CANCELLED_MAX: usize = 1_024;
/// Maximum number of outcomes that are settled under one lock: more would make the application wait for the lock.
const SETTLED_TOGETHER: usize = 32;

/// The table of an application's waits, and of cancelled requests to it. It outlives the application's incarnations.
#[derive(Debug)]
pub struct Pending {
    inner: Mutex<Inner>,
    capacity: usize,
    /// The clock of the application.
    clock: Clock,
}

#[derive(Debug)]
struct Inner {
    next: u64,
    /// Not a tree, which would allocate whenever the first wait is opened.
    slots: HashMap<u64, Slot, BuildHasherDefault<Scatter>>,
    /// Number of replies that arrived too late.
    late: u64,
    /// Requests that were taken out of the mailbox before they were cancelled: the sender, the request's
    /// number, and the time of the cancellation. A later incarnation of the sender uses the same numbers
    /// again.
    cancelled: VecDeque<(Tid, u64, Time)>,
}

/// A hash function for numbers that this table assigns in sequence: no peer can choose colliding ones.
#[derive(Clone, Copy, Debug, Default)]
struct Scatter(u64);

impl Hasher for Scatter {
    fn finish(&self) -> u64 {
        self.0
    }

    fn write(&mut self, bytes: &[u8]) {
        bytes.iter().for_each(|byte| self.write_u64(u64::from(*byte)));
    }

    fn write_u64(&mut self, number: u64) {
        // 2^64 divided by the golden ratio: the upper bits, which the table uses as well as the lower ones,
        // differ from number to number.
        self.0 = (self.0 ^ number).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    }
}

#[derive(Debug)]
struct Slot {
    awaited: Awaited,
    /// The TID that may answer: the destination. Set when the message's destination is known.
    from: Tid,
    waker: Option<Waker>,
    settled: Option<Settlement>,
    /// For a message to many: the outcomes of its members so far.
    members: Option<Box<MemberTable>>,
}

/// The result that a wait is for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Awaited {
    /// The outcome.
    Outcome,
    /// A reply. An outcome other than `Delivered` ends the wait too, as no reply will arrive.
    Reply,
}

/// The result of a wait.
#[derive(Debug)]
pub enum Settlement {
    /// The outcome of the message.
    Outcome(Outcome),
    /// The reply.
    Reply(Message),
}

impl Pending {
    /// Creates an empty table for at most `capacity` concurrent waits.
    #[must_use]
    pub fn new(capacity: usize) -> Arc<Self> {
        Self::numbered_from(1, capacity)
    }

    /// Creates an empty table; the first wait has this number. For a process that replaces another, so that
    /// late answers to the former one do not match its own requests.
    #[must_use]
    pub fn numbered_from(first: u64, capacity: usize) -> Arc<Self> {
        Self::on_clock(Clock::WALL, first, capacity)
    }

    /// Same as [`numbered_from`](Self::numbered_from), for an application with this clock.
    #[must_use]
    pub fn on_clock(clock: Clock, first: u64, capacity: usize) -> Arc<Self> {
        let inner = Inner { next: first, slots: HashMap::default(), late: 0, cancelled: VecDeque::new() };
        Arc::new(Self { inner: Mutex::new(inner), capacity, clock })
    }

    /// Opens a wait for an answer of `from`; its number is the message's correlation. Returns `None` if too
    /// many are open.
    pub fn open(self: &Arc<Self>, awaited: Awaited, from: Tid) -> Option<Wait> {
        self.open_slot(Slot { awaited, from, waker: None, settled: None, members: None })
    }

    /// Opens a wait for the outcomes of all members of a message to `destination`, from an application of the
    /// node at `here`. It ends with the message; [`Wait::members`] returns the outcomes then, or at any time
    /// before. Returns `None` if too many are open.
    pub fn open_each(self: &Arc<Self>, destination: Tid, here: NodeAddress) -> Option<Wait> {
        let members = Some(Box::new(MemberTable::new(destination, here)));
        let awaited = Awaited::Outcome;
        self.open_slot(Slot { awaited, from: destination, waker: None, settled: None, members })
    }

    fn open_slot(self: &Arc<Self>, slot: Slot) -> Option<Wait> {
        let mut inner = lock(&self.inner);
        if inner.slots.len() >= self.capacity {
            return None;
        }
        let id = inner.next;
        inner.next += 1;
        inner.slots.insert(id, slot);
        Some(Wait { pending: self.clone(), id, is_over: AtomicBool::new(false) })
    }

    /// Consumes a message that answers a wait; returns any other.
    ///
    /// # Errors
    /// The message, which is neither a reply nor an outcome.
    pub fn intercept(&self, message: Message) -> Result<(), Message> {
        let (correlation, from) = (message.header.correlation, message.header.source);
        if message.header.flags.has(Flags::REPLY) {
            self.settle_with(correlation, from, Settlement::Reply(message));
            return Ok(());
        }
        if message.header.flags.has(Flags::OUTCOME) && message.header.kind == Kind::OUTCOME {
            // A byte that is not assigned is no outcome; the wait ends at its deadline.
            if let Some(outcome) = message.payload.first().and_then(|code| Outcome::from_code(*code)) {
                self.settle_with(correlation, from, Settlement::Outcome(outcome));
            }
            return Ok(());
        }
        Err(message)
    }

    /// Returns the number of replies that arrived too late and were dropped.
    #[must_use]
    pub fn late_replies(&self) -> u64 {
        lock(&self.inner).late
    }

    /// Records the cancellation of this request, which is not in the mailbox any more.
    fn record_cancellation(&self, ticket: Ticket) {
        let now = self.clock.now();
        let cancelled = &mut lock(&self.inner).cancelled;
        if cancelled.len() >= CANCELLED_MAX {
            cancelled.pop_front();
        }
        cancelled.push_back((ticket.source, ticket.correlation, now));
    }

    /// Returns whether `source` is known to have cancelled its request of this number, which it sent at `sent`.
    pub(crate) fn is_cancelled(&self, source: Tid, correlation: u64, sent: Time) -> bool {
        let is_it =
            |(by, number, at): &(Tid, u64, Time)| (*by, *number) == (source, correlation) && sent <= *at;
        lock(&self.inner).cancelled.iter().any(is_it)
    }

    fn settle_with(&self, id: u64, from: Tid, settlement: Settlement) {
        // A refused result is dropped without the lock: a reply may have a receipt.
        let mut settlement = Some(settlement);
        let waker = lock(&self.inner).settle(id, from, &mut settlement);
        waker.into_iter().for_each(wakes::wake);
    }
}

/// Messages that are settled under one lock at its end, also if an observer of one panics: no other code settles them.
struct Together<'a> {
    pending: &'a Pending,
    outcomes: [Option<(Ticket, Outcome)>; SETTLED_TOGETHER],
}

impl Drop for Together<'_> {
    fn drop(&mut self) {
        let mut wakers = [const { None }; SETTLED_TOGETHER];
        {
            let mut inner = lock(&self.pending.inner);
            for ((ticket, outcome), waker) in self.outcomes.iter().flatten().zip(&mut wakers) {
                let mut settlement = Some(Settlement::Outcome(*outcome));
                *waker = inner.settle(ticket.correlation, ticket.destination, &mut settlement);
            }
        }
        let _batch = wakes::Batch::begin();
        wakers.into_iter().flatten().for_each(wakes::wake);
    }
}

impl Inner {
    /// Takes a result for the wait of this number, if it has none and may be ended by this one of `from`. Returns the
    /// waker of the wait.
    fn settle(&mut self, id: u64, from: Tid, settlement: &mut Option<Settlement>) -> Option<Waker> {
        let Some(slot) = self.slots.get_mut(&id) else {
            // The wait was closed: the deadline passed, or the requesting incarnation has ended.
            self.late += u64::from(matches!(settlement, Some(Settlement::Reply(_))));
            return None;
        };
        let is_answer = match (&*settlement, slot.awaited) {
            (Some(Settlement::Outcome(_)), Awaited::Outcome)
            | (Some(Settlement::Reply(_)), Awaited::Reply) => true,
            (Some(Settlement::Outcome(outcome)), Awaited::Reply) => *outcome != Outcome::Delivered,
            (Some(Settlement::Reply(_)), Awaited::Outcome) | (None, _) => false,
        };
        // Only the destination may answer.
        if !is_answer || slot.from != from || slot.settled.is_some() {
            return None;
        }
        slot.settled = settlement.take();
        slot.waker.take()
    }
}

impl ReceiptSink for Pending {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        outcome::show(ticket, outcome);
        self.settle_with(ticket.correlation, ticket.destination, Settlement::Outcome(outcome));
    }

    fn settle_all(&self, outcomes: &mut dyn Iterator<Item = (Ticket, Outcome)>) {
        loop {
            let mut together = Together { pending: self, outcomes: [const { None }; SETTLED_TOGETHER] };
            for (place, (ticket, outcome)) in together.outcomes.iter_mut().zip(&mut *outcomes) {
                *place = Some((ticket, outcome));
                // Observers are called without the lock, and before the application can see the outcome.
                outcome::show(ticket, outcome);
            }
            if together.outcomes.last().is_none_or(Option::is_none) {
                return;
            }
        }
    }

    fn members(&self, ticket: Ticket, reports: &[MemberReport]) {
        outcome::show_members(ticket, reports);
        let mut inner = lock(&self.inner);
        if let Some(slot) = inner.slots.get_mut(&ticket.correlation)
            && slot.from == ticket.destination
            && let Some(members) = &mut slot.members
        {
            members.note(reports);
        }
    }
}

/// One open wait. Dropping it closes it.
#[derive(Debug)]
pub struct Wait {
    pending: Arc<Pending>,
    id: u64,
    /// Whether its slot was removed with its result. SYNC: Relaxed; the slots have a lock of their own.
    is_over: AtomicBool,
}

impl Wait {
    /// Returns the correlation of the answer to this wait.
    #[must_use]
    pub const fn correlation(&self) -> u64 {
        self.id
    }

    /// Returns the result, or `Pending` after storing the waker. The result ends the wait, except one for the members
    /// of a message to many.
    pub fn poll_settled(&self, cx: &Context<'_>) -> Poll<Settlement> {
        let mut inner = lock(&self.pending.inner);
        let Entry::Occupied(mut entry) = inner.slots.entry(self.id) else {
            // The slot exists as long as this wait; an earlier poll took it.
            return Poll::Ready(Settlement::Outcome(Outcome::Unknown));
        };
        let slot = entry.get_mut();
        let Some(settlement) = slot.settled.take() else {
            slot.waker = Some(cx.waker().clone());
            return Poll::Pending;
        };
        if slot.members.is_none() {
            // Removed here, so that the drop need not look for it again.
            entry.remove();
            self.is_over.store(true, Ordering::Relaxed);
        }
        Poll::Ready(settlement)
    }

    /// Returns the outcome of each member, for a wait of this kind; `last` is the outcome of the message as a
    /// whole, `None` at the deadline. See [`MemberTable::finish`].
    #[must_use]
    pub fn members(&self, last: Option<Outcome>) -> Vec<MemberOutcome> {
        let mut inner = lock(&self.pending.inner);
        let table = inner.slots.get_mut(&self.id).and_then(|slot| slot.members.take());
        drop(inner);
        table.map_or_else(Vec::new, |table| table.finish(last))
    }

    /// Returns whether no result has arrived yet.
    pub(crate) fn is_open(&self) -> bool {
        let inner = lock(&self.pending.inner);
        inner.slots.get(&self.id).is_some_and(|slot| slot.settled.is_none())
    }
}

impl Drop for Wait {
    fn drop(&mut self) {
        if !*self.is_over.get_mut() {
            lock(&self.pending.inner).slots.remove(&self.id);
        }
    }
}

/// Returns whether this may be an answer. Checked first, because most messages are none, and moving one costs as much.
const fn is_answer(header: &Header) -> bool {
    header.flags.has(Flags::REPLY) || header.flags.has(Flags::OUTCOME)
}

/// The message sink of an application: answers go to its waits, all other messages to its mailbox.
pub struct AppSink<O> {
    /// The pending waits of the application.
    pub pending: Arc<Pending>,
    /// The destination of all other messages.
    pub inbox: Arc<O>,
}

impl<O: MessageSink> MessageSink for AppSink<O> {
    fn submit(&self, message: Message) -> Result<(), SubmitError> {
        if !is_answer(&message.header) {
            return self.inbox.submit(message);
        }
        match self.pending.intercept(message) {
            Ok(()) => Ok(()),
            Err(message) => self.inbox.submit(message),
        }
    }

    fn offer(&self, message: Message, room: Option<&Waker>) -> Result<(), SubmitError> {
        if is_answer(&message.header) { self.submit(message) } else { self.inbox.offer(message, room) }
    }

    fn cancel(&self, ticket: Ticket) -> bool {
        if !self.inbox.cancel(ticket) {
            // The handler has or had the request, and may still reply.
            self.pending.record_cancellation(ticket);
        }
        true
    }
}

#[cfg(test)]
mod tests {
    use futures_util::task::noop_waker;

    use super::*;

    fn ticket(wait: &Wait) -> Ticket {
        Ticket { source: Tid::NONE, destination: Tid::NONE, correlation: wait.correlation() }
    }

    fn poll(wait: &Wait) -> Poll<Settlement> {
        wait.poll_settled(&Context::from_waker(&noop_waker()))
    }

    #[test]
    fn delivered_request_waits_for_reply_but_failed_does_not() {
        let pending = Pending::new(4);
        let wait = pending.open(Awaited::Reply, Tid::NONE).unwrap();
        pending.settle(ticket(&wait), Outcome::Delivered);
        assert!(poll(&wait).is_pending());
        pending.settle(ticket(&wait), Outcome::Failed);
        assert!(matches!(poll(&wait), Poll::Ready(Settlement::Outcome(Outcome::Failed))));
    }

    #[test]
    fn outcomes_settle_together_as_one_by_one() {
        for count in [1, SETTLED_TOGETHER, SETTLED_TOGETHER + 1, 3 * SETTLED_TOGETHER] {
            let pending = Pending::new(count);
            let waits: Vec<_> =
                (0..count).map(|_| pending.open(Awaited::Outcome, Tid::NONE).unwrap()).collect();
            let outcomes = [Outcome::Delivered, Outcome::Failed, Outcome::Expired];
            let outcomes: Vec<_> = waits.iter().map(ticket).zip(outcomes.into_iter().cycle()).collect();
            let foreign = (Ticket { destination: Tid::from_bits(7), ..ticket(&waits[0]) }, Outcome::Unknown);
            // One of another destination, and each twice: the first counts.
            let again = outcomes.iter().map(|(ticket, _)| (*ticket, Outcome::Unknown));
            let mut all = std::iter::once(foreign).chain(outcomes.iter().copied()).chain(again);
            pending.settle_all(&mut all);
            assert!(all.next().is_none());
            for (wait, (_, expected)) in waits.iter().zip(&outcomes) {
                assert!(
                    matches!(poll(wait), Poll::Ready(Settlement::Outcome(outcome)) if outcome == *expected)
                );
            }
        }
    }

    #[test]
    fn other_receiver_cannot_answer_a_request() {
        let pending = Pending::new(4);
        let wait = pending.open(Awaited::Reply, Tid::from_bits(7)).unwrap();
        let reply = |source| {
            let mut header = Header::new(Kind::named("reply"), Tid::from_bits(source), Tid::NONE);
            (header.flags, header.correlation) = (Flags::REPLY, wait.correlation());
            Message::new(header, bytes::Bytes::new())
        };
        pending.intercept(reply(8)).unwrap();
        assert!(poll(&wait).is_pending());
        pending.intercept(reply(7)).unwrap();
        assert!(matches!(poll(&wait), Poll::Ready(Settlement::Reply(_))));
    }

    #[test]
    fn waits_are_bounded_and_dropping_one_makes_room() {
        let pending = Pending::new(1);
        let wait = pending.open(Awaited::Outcome, Tid::NONE).unwrap();
        assert!(pending.open(Awaited::Outcome, Tid::NONE).is_none());
        drop(wait);
        assert!(pending.open(Awaited::Outcome, Tid::NONE).is_some());
    }

    #[test]
    fn read_result_ends_its_wait() {
        let pending = Pending::new(1);
        let wait = pending.open(Awaited::Outcome, Tid::NONE).unwrap();
        pending.settle(ticket(&wait), Outcome::Delivered);
        assert!(pending.open(Awaited::Outcome, Tid::NONE).is_none(), "it was not read");
        assert!(matches!(poll(&wait), Poll::Ready(Settlement::Outcome(Outcome::Delivered))));
        let next = pending.open(Awaited::Outcome, Tid::NONE).unwrap();
        assert!(matches!(poll(&wait), Poll::Ready(Settlement::Outcome(Outcome::Unknown))), "it is over");
        drop(wait);
        assert!(poll(&next).is_pending(), "another one has its room, not its number");
        assert!(pending.open(Awaited::Outcome, Tid::NONE).is_none());
    }

    #[test]
    fn late_reply_is_counted() {
        let pending = Pending::new(1);
        let late = pending.open(Awaited::Reply, Tid::NONE).unwrap();
        let mut header = Header::new(Kind::named("reply"), Tid::NONE, Tid::NONE);
        (header.flags, header.correlation) = (Flags::REPLY, late.correlation());
        drop(late);
        pending.intercept(Message::new(header, bytes::Bytes::new())).unwrap();
        assert_eq!(pending.late_replies(), 1);
    }

    #[test]
    fn newest_cancelled_requests_are_known() {
        let pending = Pending::new(1);
        let requester = Tid::from_bits(7);
        let request = |correlation| Ticket { source: requester, destination: Tid::NONE, correlation };
        let before = Time::now();
        (0..=CANCELLED_MAX as u64).for_each(|number| pending.record_cancellation(request(number)));
        assert!(!pending.is_cancelled(requester, 0, before), "the oldest is forgotten");
        assert!(pending.is_cancelled(requester, 1, before));
        assert!(!pending.is_cancelled(Tid::from_bits(8), 1, before), "somebody else's");
        assert!(!pending.is_cancelled(requester, 1, Time::now() + std::time::Duration::from_secs(1)));
    }

    #[test]
    fn late_answer_matches_no_request() {
        let pending = Pending::new(1);
        let late = ticket(&pending.open(Awaited::Outcome, Tid::NONE).unwrap());
        pending.settle(late, Outcome::Delivered);
        let wait = pending.open(Awaited::Outcome, Tid::NONE).unwrap();
        assert!(poll(&wait).is_pending(), "numbers are never used twice");
    }
}
