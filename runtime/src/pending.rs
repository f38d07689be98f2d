//! What an application waits for: outcomes of its confirmed messages and replies to its requests.

use std::{
    collections::HashMap,
    sync::{Arc, Mutex},
    task::{Context, Poll, Waker},
};

use crate::{
    outcome::{Outcome, ReceiptSink, Ticket},
    post::lock,
    router::{Outlet, Refused},
    tid::Tid,
    wire::{Flags, Header, Kind, Message},
};

/// The table of what one application waits for. It outlives the application's incarnations.
#[derive(Debug)]
pub struct Pending {
    inner: Mutex<Inner>,
    capacity: usize,
}

#[derive(Debug)]
struct Inner {
    next: u64,
    /// Not a tree: that would allocate whenever the first wait is opened.
    slots: HashMap<u64, Slot>,
}

#[derive(Debug)]
struct Slot {
    awaited: Awaited,
    /// Who may answer: whoever was asked. Set when the message's destination is known.
    from: Tid,
    waker: Option<Waker>,
    settled: Option<Settlement>,
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
        Arc::new(Self { inner: Mutex::new(Inner { next: first, slots: HashMap::new() }), capacity })
    }

    /// Opens a wait for what `from` says; its number is the message's correlation. `None` if too many are open.
    pub fn open(self: &Arc<Self>, awaited: Awaited, from: Tid) -> Option<Wait> {
        let mut inner = lock(&self.inner);
        if inner.slots.len() >= self.capacity {
            return None;
        }
        let id = inner.next;
        inner.next += 1;
        inner.slots.insert(id, Slot { awaited, from, waker: None, settled: None });
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

    fn settle_with(&self, id: u64, from: Tid, settlement: Settlement) {
        let waker = {
            let mut inner = lock(&self.inner);
            // Nobody waits any more: the deadline passed, or the asking incarnation is gone.
            let Some(slot) = inner.slots.get_mut(&id) else { return };
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
        if let Some(waker) = waker {
            waker.wake();
        }
    }
}

impl ReceiptSink for Pending {
    fn settle(&self, ticket: Ticket, outcome: Outcome) {
        self.settle_with(ticket.correlation, ticket.destination, Settlement::Outcome(outcome));
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
    fn an_answer_that_comes_too_late_is_nobodys() {
        let pending = Pending::new(1);
        let late = ticket(&pending.open(Awaited::Outcome, Tid::NONE).unwrap());
        pending.settle(late, Outcome::Delivered);
        let wait = pending.open(Awaited::Outcome, Tid::NONE).unwrap();
        assert!(poll(&wait).is_pending(), "numbers are never used twice");
    }
}
