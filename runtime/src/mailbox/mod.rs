//! Mailboxes: bounded, outside the actor, outliving its restarts.
//!
//! A mailbox belongs to a TID, not to an actor. Any thread puts messages in; the present incarnation of the actor takes
//! them out. When the actor panics the message in its hand ends as `Failed`, the rest stays and goes to the next
//! incarnation. Queue and waker stand under one mutex, see [`post`](crate::post).

mod about;
mod budget;
mod ends;
mod lender;
mod queue;
mod reader;
mod request;
mod room;
mod source;
mod tally;
#[cfg(test)]
mod tests;

use std::{
    collections::VecDeque,
    sync::{Arc, Mutex, OnceLock, TryLockError},
    task::Waker,
};

pub use about::About;
pub use budget::Budget;
pub use lender::Lender;
pub use queue::{Bounds, ClassQueue, is_same_stream};
pub use reader::MailboxReader;
pub use source::Source;
pub use tally::Tally;

use crate::{
    outcome::{Outcome, Rejection, Ticket},
    post::lock,
    router::{Outlet, Refused},
    tid::Tid,
    time::Time,
    undelivered::{RefusalSink, is_reported},
    wakes,
    wire::{Class, Header, Message},
};

/// The mailbox of one TID.
#[derive(Debug)]
pub struct Mailbox {
    shared: Mutex<Shared>,
    /// Where its messages wait, if not here.
    source: Option<Arc<dyn Source>>,
    /// Who reports refusals of what had been taken, and whose mailbox this is.
    refusals: OnceLock<(Tid, Arc<dyn RefusalSink>)>,
}

#[derive(Debug)]
struct Shared {
    queue: ClassQueue,
    /// What this node's layers say: ahead of everything else, but for what is [said of a node's end](About::End).
    events: VecDeque<Message>,
    events_max: usize,
    /// The reader takes nothing but events, and is not woken for anything else.
    paused: bool,
    waker: Option<Waker>,
    /// Which reader is the present one.
    epoch: u64,
    /// Class of the message in the present reader's hand.
    in_hand: Option<Class>,
    /// Messages taken out so far.
    taken_out: u64,
    /// Messages of each class that are out with a [`Lender`].
    lent: [u64; 3],
    /// The present reader is a [`Lender`].
    is_lent: bool,
    closed: bool,
    /// The application is away and wants nothing kept for it.
    refuses: bool,
    tallies: [Tally; 3],
    high_water: usize,
}

impl Shared {
    /// Takes out everything that waits, to be refused.
    fn empty(&mut self) -> Vec<Message> {
        let waiting = self.queue.drain_all().collect();
        self.rejected(waiting)
    }

    /// Takes out every event.
    fn take_events(&mut self) -> Vec<Message> {
        let mut events = Vec::from(std::mem::take(&mut self.events));
        events.extend(self.queue.take_events());
        self.rejected(events)
    }

    fn rejected(&mut self, waiting: Vec<Message>) -> Vec<Message> {
        for message in &waiting {
            self.tallies[message.header.class as usize].rejected += 1;
        }
        waiting
    }

    fn next(&mut self) -> Option<Message> {
        if self.events.is_empty() { self.queue.pop() } else { self.events.pop_front() }
    }

    fn waiting(&self) -> usize {
        self.events.len() + self.queue.len()
    }

    /// Half of the places are not for events that wait behind messages: what ends a pause is an event itself, and those wait as long as
    /// the pause lasts.
    fn has_room_for_event(&self, event: &Header) -> bool {
        let kept = self.queue.kept_events();
        if self.events.len() + kept >= self.events_max {
            return false;
        }
        // Behind which messages a borrower keeps an event about a node is not known here.
        let (stay, stays) = if self.is_lent {
            let about_nodes = self.events.iter().filter(|event| About::of(&event.header).is_some()).count();
            (kept + about_nodes, About::of(event).is_some())
        } else {
            (kept, self.queue.keeps(event))
        };
        !stays || stay < self.events_max / 2
    }

    fn submit_event(&mut self, event: Message) -> Result<Option<Waker>, Refused> {
        let has_room = self.has_room_for_event(&event.header);
        let tally = &mut self.tallies[event.header.class as usize];
        if !has_room {
            tally.refused += 1;
            return Err(Refused::new(event, Rejection::QueueFull));
        }
        tally.taken += 1;
        let Some(event) = self.queue.keep_behind(event) else {
            // It waits with messages, which are not taken in a pause.
            self.high_water = self.high_water.max(self.waiting());
            return Ok(if self.paused { None } else { self.waker.take() });
        };
        self.events.push_back(event);
        self.high_water = self.high_water.max(self.waiting());
        Ok(self.waker.take())
    }

    /// Messages of `class` that wait, or are in hand, or lent: counted one by one.
    fn held(&self, class: Class) -> u64 {
        let events = self.events.iter().filter(|event| event.header.class == class).count();
        let in_hand = u64::from(self.in_hand == Some(class));
        (events + self.queue.len_of(class)) as u64 + in_hand + self.lent[class as usize]
    }

    const fn hands_out(&mut self, message: &Message) -> Option<Class> {
        self.taken_out += 1;
        self.in_hand = Some(message.header.class);
        self.in_hand
    }

    /// The message in the reader's hand has ended so.
    fn count(&mut self, finished: Option<(Class, Outcome)>) {
        if let Some((class, outcome)) = finished {
            self.tallies[class as usize].count(outcome);
            self.in_hand = None;
        }
    }

    /// Fences the present reader off; what it has in its hand has failed.
    fn next_reader(&mut self) {
        self.epoch += 1;
        if let Some(class) = self.in_hand.take() {
            self.tallies[class as usize].count(Outcome::Failed);
        }
    }

    fn expire(&mut self, now: Time) -> Vec<Message> {
        let expired = self.queue.take_expired(now);
        for message in &expired {
            self.tallies[message.header.class as usize].expired += 1;
        }
        expired
    }
}

impl Mailbox {
    /// An empty mailbox that holds at most so much of each class.
    #[must_use]
    pub fn new(bounds: impl Into<Bounds>) -> Arc<Self> {
        Arc::new(Self::with_source(bounds.into(), None))
    }

    /// The mailbox of a process that hosts one application: its reader takes from `source`.
    #[must_use]
    pub fn fed_by(source: Arc<dyn Source>) -> Arc<Self> {
        Arc::new(Self::with_source(Bounds { messages: 0, bytes: 0 }, Some(source)))
    }

    fn with_source(bounds: Bounds, source: Option<Arc<dyn Source>>) -> Self {
        let shared = Shared {
            queue: ClassQueue::new(bounds),
            events: VecDeque::new(),
            events_max: bounds.messages,
            paused: false,
            waker: None,
            epoch: 0,
            in_hand: None,
            taken_out: 0,
            lent: [0; 3],
            is_lent: false,
            closed: false,
            refuses: false,
            tallies: [Tally::default(); 3],
            high_water: 0,
        };
        Self { shared: Mutex::new(shared), source, refusals: OnceLock::new() }
    }

    /// Has refusals of unconfirmed messages that had been taken here told to `sink`, as by `owner`. Set once.
    pub fn report_refusals(&self, owner: Tid, sink: Arc<dyn RefusalSink>) {
        // Whoever sets a second one keeps it for itself.
        let _ = self.refusals.set((owner, sink));
    }

    /// Refuses a message that had been taken. To be called without a lock.
    pub(super) fn reject(&self, message: Message, why: Rejection) {
        if let Some((owner, sink)) = self.refusals.get()
            && is_reported(&message.header, why)
        {
            sink.refused(*owner, &message.header, why, 1);
        }
        message.reject(why);
    }

    /// Takes over the reading end for a new incarnation; the former reader is fenced off.
    #[must_use]
    pub fn attach(self: &Arc<Self>) -> MailboxReader {
        let (epoch, former) = {
            let mut shared = lock(&self.shared);
            shared.next_reader();
            (shared.paused, shared.is_lent) = (false, false);
            (shared.epoch, shared.waker.take())
        };
        if let Some(waker) = former {
            waker.wake();
        }
        MailboxReader::new(self.clone(), epoch)
    }

    /// Fences reader number `epoch` off, if it is the present one. What waits is kept for the next.
    pub(crate) fn detach(&self, epoch: u64) {
        let mut shared = lock(&self.shared);
        if shared.epoch == epoch {
            shared.next_reader();
        }
    }

    /// Messages that wait to be taken, and how many were taken out so far; `None` if somebody is at it this very moment.
    pub(crate) fn backlog(&self) -> Option<(usize, u64)> {
        if let Some(source) = &self.source {
            return source.backlog();
        }
        let shared = match self.shared.try_lock() {
            Ok(shared) => shared,
            Err(TryLockError::Poisoned(poisoned)) => poisoned.into_inner(),
            Err(TryLockError::WouldBlock) => return None,
        };
        // In a pause only the layers' events are to be taken.
        let waiting = if shared.paused { shared.events.len() } else { shared.waiting() };
        Some((waiting, shared.taken_out))
    }

    /// Refuses everything that waits and everything that comes.
    pub fn close(&self) {
        let (waiting, wakers) = {
            let mut shared = lock(&self.shared);
            shared.closed = true;
            let mut waiting = shared.take_events();
            waiting.extend(shared.empty());
            (waiting, [shared.waker.take(), shared.queue.awaited_no_more()])
        };
        for message in waiting {
            self.reject(message, Rejection::Closed);
        }
        wakers.into_iter().flatten().for_each(Waker::wake);
    }

    /// The application is away: refuses everything that waits and everything that comes, until it [is back](Self::is_back).
    pub fn refuse_while_away(&self) {
        let (waiting, waker) = {
            let mut shared = lock(&self.shared);
            shared.refuses = true;
            (shared.empty(), shared.queue.awaited_no_more())
        };
        for message in waiting {
            self.reject(message, Rejection::Down);
        }
        waker.into_iter().for_each(Waker::wake);
    }

    /// Drops the layers' events that wait: the life that they were for has ended.
    pub fn forget_events(&self) {
        let events = lock(&self.shared).take_events();
        for event in events {
            event.reject(Rejection::Down);
        }
    }

    /// The application is ready again.
    pub fn is_back(&self) {
        lock(&self.shared).refuses = false;
    }

    /// Takes messages again, after it was [closed](Self::close).
    pub fn reopen(&self) {
        lock(&self.shared).closed = false;
    }

    /// Messages that wait now.
    #[must_use]
    pub fn depth(&self) -> usize {
        lock(&self.shared).waiting()
    }

    /// The most messages that ever waited at once.
    #[must_use]
    pub fn high_water(&self) -> usize {
        lock(&self.shared).high_water
    }

    /// What became of the messages of `class`, and how many wait, are in hand or lent at that same moment:
    /// [`Tally::open`] of the former is the latter.
    #[must_use]
    pub fn account(&self, class: Class) -> (Tally, u64) {
        let shared = lock(&self.shared);
        (shared.tallies[class as usize], shared.held(class))
    }

    /// What became of the messages of `class`.
    #[must_use]
    pub fn tally(&self, class: Class) -> Tally {
        lock(&self.shared).tallies[class as usize]
    }
}

impl Outlet for Mailbox {
    fn submit(&self, message: Message) -> Result<(), Refused> {
        let class = message.header.class as usize;
        let mut expired = Vec::new();
        let is_event = is_event(&message.header);
        let taken = {
            let mut shared = lock(&self.shared);
            if shared.closed {
                shared.tallies[class].refused += 1;
                return Err(Refused::new(message, Rejection::Closed));
            }
            if is_event {
                let waker = shared.submit_event(message)?;
                drop(shared);
                waker.into_iter().for_each(wakes::wake);
                return Ok(());
            }
            if shared.refuses {
                shared.tallies[class].refused += 1;
                return Err(Refused::new(message, Rejection::Down));
            }
            if message.receipt.is_some() && message.header.class == Class::Stream {
                shared.tallies[class].refused += 1;
                return Err(Refused::new(message, Rejection::Unsupported));
            }
            if !shared.queue.has_room_for(&message) {
                // An application that waits for its start takes nothing out: what has expired makes room.
                expired = shared.expire(Time::now());
            }
            match shared.queue.push(message) {
                Ok(superseded) => {
                    shared.tallies[class].taken += 1;
                    shared.tallies[class].superseded += u64::from(superseded.is_some());
                    shared.high_water = shared.high_water.max(shared.waiting());
                    Ok(if shared.paused { None } else { shared.waker.take() })
                }
                Err(refused) => {
                    shared.tallies[class].refused += 1;
                    Err(refused)
                }
            }
        };
        // Settled and woken outside the lock, so that nobody who is told runs into it.
        for mut message in expired {
            message.settle(Outcome::Expired);
        }
        taken.map(|waker| waker.into_iter().for_each(wakes::wake))
    }

    fn offer(&self, message: Message, room: Option<&Waker>) -> Result<(), Refused> {
        let result = self.submit(message);
        if let Err(Refused { message, why: Rejection::QueueFull }) = &result {
            let waker = {
                let mut shared = lock(&self.shared);
                // It is offered again.
                shared.tallies[message.header.class as usize].refused -= 1;
                room.and_then(|room| shared.queue.offered(message, room))
            };
            waker.into_iter().for_each(Waker::wake);
        }
        result
    }

    fn cancel(&self, ticket: Ticket) -> bool {
        self.take_back(ticket)
    }
}

/// Whether one of the node's own layers says something to an application of it: who is there, what it requires, who died.
#[must_use]
pub fn is_event(header: &Header) -> bool {
    header.source.app.is_layer() && header.source.node == header.destination.node && header.kind.is_user()
}
