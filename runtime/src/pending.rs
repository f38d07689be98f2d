//! What an application waits for: outcomes of its confirmed messages and replies to its requests.

use std::{
    collections::{HashMap, VecDeque},
    hash::{BuildHasherDefault, Hasher},
    sync::{Arc, Mutex},
    task::{Context, Poll, Waker},
};

use crate::{
    outcome::{MemberOutcome, MemberReport, MemberTable, Outcome, ReceiptSink, Ticket},
    post::lock,
    router::{Outlet, Refused},
    tid::{NodeAddress, Tid},
    time::Time,
    wakes,
    wire::{Flags, Header, Kind, Message},
};

/// Requests to one application of which it is known that nobody waits any more: of more the oldest is forgotten, and its
/// deadline is all that says so.
const UNWANTED_MAX: usize = 1_024;

/// The table of what one application waits for, and of who does not wait for it any more. It outlives the application's incarnations.
#[derive(Debug)]
pub struct Pending {
    inner: Mutex<Inner>,
    capacity: usize,
}

#[derive(Debug)]
struct Inner {
    next: u64,
    /// Not a tree: that would allocate whenever the first wait is opened.
    slots: HashMap<u64, Slot, BuildHasherDefault<Scatter>>,
    /// Replies that came when nobody waited for them any more.
    late: u64,
    /// Requests that were taken out of the mailbox before they were given up: who asked, the request's number, and when it was
    /// given up: a later life of whoever asked counts anew.
    unwanted: VecDeque<(Tid, u64, Time)>,
}

/// Spreads numbers that this table gave out itself, one after the other: nobody can choose those that fall together.
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
        // 2^64 by the golden ratio: the upper bits, which the table takes as well as the lower ones, differ from number to number.
        self.0 = (self.0 ^ number).wrapping_mul(0x9e37_79b9_7f4a_7c15);
    }
}

#[derive(Debug)]
struct Slot {
    awaited: Awaited,
    /// Who may answer: whoever was asked. Set when the message's destination is known.
    from: Tid,
    waker: Option<Waker>,
    settled: Option<Settlement>,
    /// Of a message to many: what became of it at each member so far.
    members: Option<Box<MemberTable>>,
}

/// What is waited for.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub enum Awaited {
    /// The outcome.
    Outcome,
    /// A reply; an outcome other than `Delivered` ends the wait too, for no reply will come.
    Reply,
}

/// What came.
#[derive(Debug)]
pub enum Settlement {
    /// The message's fate.
    Outcome(Outcome),
    /// The reply.
    Reply(Message),
}

impl Pending {
    /// An empty table for at most `capacity` waits at once.
    #[must_use]
    pub fn new(capacity: usize) -> Arc<Self> {
        Self::numbered_from(1, capacity)
    }

    /// An empty table whose first wait has this number: for a process that takes another's place, so that no late answer
    /// to the former is taken for one to its own.
    #[must_use]
    pub fn numbered_from(first: u64, capacity: usize) -> Arc<Self> {
        let inner = Inner { next: first, slots: HashMap::default(), late: 0, unwanted: VecDeque::new() };
        Arc::new(Self { inner: Mutex::new(inner), capacity })
    }

    /// Opens a wait for what `from` says; its number is the message's correlation. `None` if too many are open.
    pub fn open(self: &Arc<Self>, awaited: Awaited, from: Tid) -> Option<Wait> {
        self.open_slot(Slot { awaited, from, waker: None, settled: None, members: None })
    }

    /// Opens a wait for the outcomes of all members of a message to `destination`, from an application of the node at `here`. It ends when the
    /// message does; then, or at any time before, [`Wait::members`] has them. `None` if too many are open.
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
        Some(Wait { pending: self.clone(), id })
    }

    /// Takes a message that answers a wait; hands back any other.
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
            // A byte that means nothing is no outcome; the wait ends at its deadline.
            if let Some(outcome) = message.payload.first().and_then(|code| Outcome::from_code(*code)) {
                self.settle_with(correlation, from, Settlement::Outcome(outcome));
            }
            return Ok(());
        }
        Err(message)
    }

    /// Replies that came when nobody waited for them any more, and were dropped.
    #[must_use]
    pub fn late_replies(&self) -> u64 {
        lock(&self.inner).late
    }

    /// Nobody waits any more for the reply to this request, which is not in the mailbox.
    fn give_up(&self, ticket: Ticket) {
        let unwanted = &mut lock(&self.inner).unwanted;
        if unwanted.len() >= UNWANTED_MAX {
            unwanted.pop_front();
        }
        unwanted.push_back((ticket.source, ticket.correlation, Time::now()));
    }

    /// Whether `source` is known to have given up its request of this number, which it sent at `sent`.
    pub(crate) fn is_given_up(&self, source: Tid, correlation: u64, sent: Time) -> bool {
        let is_it =
            |(by, number, at): &(Tid, u64, Time)| (*by, *number) == (source, correlation) && sent <= *at;
        lock(&self.inner).unwanted.iter().any(is_it)
    }

    fn settle_with(&self, id: u64, from: Tid, settlement: Settlement) {
        let waker = {
            let mut inner = lock(&self.inner);
            let Some(slot) = inner.slots.get_mut(&id) else {
                // Nobody waits any more: the deadline passed, or the asking incarnation is gone.
                inner.late += u64::from(matches!(settlement, Settlement::Reply(_)));
                return;
            };
            let is_answer = match (&settlement, slot.awaited) {
                (Settlement::Outcome(_), Awaited::Outcome) | (Settlement::Reply(_), Awaited::Reply) => true,
                (Settlement::Outcome(outcome), Awaited::Reply) => *outcome != Outcome::Delivered,
                (Settlement::Reply(_), Awaited::Outcome) => false,
            };
            // Nobody answers for another.
            if !is_answer || slot.from != from || slot.settled.is_some() {
                return;
            }
            slot.settled = Some(settlement);
            slot.waker.take()
        };
        waker.into_iter().for_each(wakes::wake);
    }
}

impl ReceiptSink for Pending {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        self.settle_with(ticket.correlation, ticket.destination, Settlement::Outcome(outcome));
    }

    fn members(&self, ticket: Ticket, reports: &[MemberReport]) {
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
}

impl Wait {
    /// The correlation by which the answer will name this wait.
    #[must_use]
    pub const fn correlation(&self) -> u64 {
        self.id
    }

    /// What came, or `Pending` with the waker kept.
    pub fn poll_settled(&self, cx: &Context<'_>) -> Poll<Settlement> {
        let mut inner = lock(&self.pending.inner);
        let Some(slot) = inner.slots.get_mut(&self.id) else {
            // The slot lives as long as this wait; it was taken by an earlier poll.
            return Poll::Ready(Settlement::Outcome(Outcome::Unknown));
        };
        if let Some(settlement) = slot.settled.take() {
            return Poll::Ready(settlement);
        }
        slot.waker = Some(cx.waker().clone());
        Poll::Pending
    }

    /// The outcome of each member, where it is waited for these; `last` is the outcome of the message as a whole, `None` at the deadline. See
    /// [`MemberTable::finish`].
    #[must_use]
    pub fn members(&self, last: Option<Outcome>) -> Vec<MemberOutcome> {
        let mut inner = lock(&self.pending.inner);
        let table = inner.slots.get_mut(&self.id).and_then(|slot| slot.members.take());
        drop(inner);
        table.map_or_else(Vec::new, |table| table.finish(last))
    }

    /// Whether nothing has come yet.
    pub(crate) fn is_open(&self) -> bool {
        let inner = lock(&self.pending.inner);
        inner.slots.get(&self.id).is_some_and(|slot| slot.settled.is_none())
    }
}

impl Drop for Wait {
    fn drop(&mut self) {
        lock(&self.pending.inner).slots.remove(&self.id);
    }
}

/// Whether this may be what somebody waits for: looked at first, for most messages are not, and moving one costs as much.
const fn is_answer(header: &Header) -> bool {
    header.flags.has(Flags::REPLY) || header.flags.has(Flags::OUTCOME)
}

/// An application's outlet: answers go to its waits, all else to its mailbox.
pub struct AppOutlet<O> {
    /// What the application waits for.
    pub pending: Arc<Pending>,
    /// Where everything else goes.
    pub inbox: Arc<O>,
}

impl<O: Outlet> Outlet for AppOutlet<O> {
    fn submit(&self, message: Message) -> Result<(), Refused> {
        if !is_answer(&message.header) {
            return self.inbox.submit(message);
        }
        match self.pending.intercept(message) {
            Ok(()) => Ok(()),
            Err(message) => self.inbox.submit(message),
        }
    }

    fn offer(&self, message: Message, room: Option<&Waker>) -> Result<(), Refused> {
        if is_answer(&message.header) { self.submit(message) } else { self.inbox.offer(message, room) }
    }

    fn cancel(&self, ticket: Ticket) -> bool {
        if !self.inbox.cancel(ticket) {
            // Its handler has it, or had it, and may reply yet.
            self.pending.give_up(ticket);
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
    fn a_delivered_request_still_waits_for_its_reply_but_a_failed_one_does_not() {
        let pending = Pending::new(4);
        let wait = pending.open(Awaited::Reply, Tid::NONE).unwrap();
        pending.settle(ticket(&wait), Outcome::Delivered);
        assert!(poll(&wait).is_pending());
        pending.settle(ticket(&wait), Outcome::Failed);
        assert!(matches!(poll(&wait), Poll::Ready(Settlement::Outcome(Outcome::Failed))));
    }

    #[test]
    fn nobody_answers_a_request_that_was_put_to_another() {
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
    fn a_reply_that_comes_too_late_is_counted() {
        let pending = Pending::new(1);
        let late = pending.open(Awaited::Reply, Tid::NONE).unwrap();
        let mut header = Header::new(Kind::named("reply"), Tid::NONE, Tid::NONE);
        (header.flags, header.correlation) = (Flags::REPLY, late.correlation());
        drop(late);
        pending.intercept(Message::new(header, bytes::Bytes::new())).unwrap();
        assert_eq!(pending.late_replies(), 1);
    }

    #[test]
    fn of_requests_that_were_given_up_the_newest_are_known_and_a_later_life_counts_anew() {
        let pending = Pending::new(1);
        let asker = Tid::from_bits(7);
        let request = |correlation| Ticket { source: asker, destination: Tid::NONE, correlation };
        let before = Time::now();
        (0..=UNWANTED_MAX as u64).for_each(|number| pending.give_up(request(number)));
        assert!(!pending.is_given_up(asker, 0, before), "the oldest is forgotten");
        assert!(pending.is_given_up(asker, 1, before));
        assert!(!pending.is_given_up(Tid::from_bits(8), 1, before), "somebody else's");
        assert!(!pending.is_given_up(asker, 1, Time::now() + std::time::Duration::from_secs(1)));
    }

    #[test]
    fn an_answer_that_comes_too_late_is_nobodys() {
        let pending = Pending::new(1);
        let late = ticket(&pending.open(Awaited::Outcome, Tid::NONE).unwrap());
        pending.settle(late, Outcome::Delivered);
        let wait = pending.open(Awaited::Outcome, Tid::NONE).unwrap();
        assert!(poll(&wait).is_pending(), "numbers are never used twice");
    }
}
