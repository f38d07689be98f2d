//! Mailboxes: bounded, outside of the actor, and kept through its restarts.
//!
//! A mailbox belongs to a TID, not to an actor. Any thread adds messages; the current incarnation of the
//! actor takes them out. When the actor panics, its current message ends as `Failed`; the others stay for the
//! next incarnation. Queue and waker are under one mutex, see [`event_queue`](crate::event_queue).

mod about;
mod ages;
mod backlog;
mod budget;
mod ends;
mod queue;
mod reader;
mod remote_reader;
mod request;
mod room;
mod source;
mod tally;
#[cfg(test)]
mod tests;

use std::{
    collections::VecDeque,
    sync::{Arc, Mutex, OnceLock, atomic::AtomicBool},
    task::Waker,
};

pub use about::About;
pub use ages::{AGE_BOUNDS_US, AGE_BUCKETS, MessageAges};
pub(crate) use backlog::Backlog;
use backlog::WaitRecord;
pub use budget::Budget;
pub use queue::{Bounds, ClassQueue, is_same_stream};
use reader::Finished;
pub use reader::MailboxReader;
pub use remote_reader::RemoteReader;
use room::RoomWakers;
pub use source::Source;
pub use tally::Tally;

use crate::{
    clock::Clock,
    lock,
    outcome::{Outcome, Rejection, Ticket},
    router::{MessageSink, SubmitError},
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
    /// The source of its messages, if they are not queued here.
    source: Option<Arc<dyn Source>>,
    /// The sink for rejections of accepted messages, and the TID of this mailbox.
    refusals: OnceLock<(Tid, Arc<dyn RefusalSink>)>,
    /// Whether it is recorded since when messages wait.
    records_waits: AtomicBool,
    /// The clock on which its messages expire.
    clock: Clock,
}

#[derive(Debug)]
struct Shared {
    queue: ClassQueue,
    /// Events of this node's layers: before all other messages, except those that must precede a [node's
    /// end](About::End).
    events: VecDeque<Message>,
    events_max: usize,
    /// Whether the reader takes only events, and is not woken for other messages.
    paused: bool,
    waker: Option<Waker>,
    /// Woken when a message or an event is removed, because an event found no room.
    event_waits: Option<Waker>,
    /// The number of the current reader.
    epoch: u64,
    /// The class of the message that the reader handles.
    current: Option<Class>,
    /// The number of messages taken out so far.
    taken_out: u64,
    /// See [`Backlog::since`].
    waiting_since: Option<WaitRecord>,
    /// The number of messages of each class that are in flight to a [`RemoteReader`].
    in_flight: [u64; 3],
    /// Whether the current reader is a [`RemoteReader`].
    is_remote: bool,
    closed: bool,
    /// Whether the application is down and its policy keeps no messages.
    refuses: bool,
    tallies: [Tally; 3],
    ages: MessageAges,
    high_water: usize,
}

impl Shared {
    /// Returns the wakers of the senders that wait for room, after a removal. An event is offered again after each
    /// removal, as its place may depend on each message.
    fn room_made(&mut self) -> RoomWakers {
        RoomWakers { of_messages: self.queue.room_made(), of_events: self.event_waits.take() }
    }

    /// Returns the wakers of the senders that wait for room, which must be notified of another change.
    fn awaited_no_more(&mut self) -> RoomWakers {
        RoomWakers { of_messages: self.queue.awaited_no_more(), of_events: self.event_waits.take() }
    }

    /// Removes all queued messages, to be rejected.
    fn empty(&mut self) -> Vec<Message> {
        let waiting = self.queue.drain_all().collect();
        self.rejected(waiting)
    }

    /// Removes all events.
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

    /// Returns the number of queued messages that the reader can take: during a pause only the layers' events.
    fn takeable(&self) -> usize {
        if self.paused { self.events.len() } else { self.waiting() }
    }

    /// Reserves half of the positions for events that do not wait behind messages. The end of a pause is an
    /// event itself, and those that wait behind messages stay for as long as the pause.
    fn has_room_for_event(&self, event: &Header) -> bool {
        let kept = self.queue.events_behind();
        if self.events.len() + kept >= self.events_max {
            return false;
        }
        // The messages behind which a remote reader keeps an event about a node are unknown here.
        let (stay, stays) = if self.is_remote {
            let about_nodes = self.events.iter().filter(|event| About::of(&event.header).is_some()).count();
            (kept + about_nodes, About::of(event).is_some())
        } else {
            (kept, self.queue.queues_behind(event))
        };
        !stays || stay < self.events_max / 2
    }

    fn submit_event(&mut self, event: Message) -> Result<Option<Waker>, SubmitError> {
        let has_room = self.has_room_for_event(&event.header);
        let tally = &mut self.tallies[event.header.class as usize];
        if !has_room {
            tally.refused += 1;
            return Err(SubmitError::new(event, Rejection::QueueFull));
        }
        tally.taken += 1;
        let Some(event) = self.queue.queue_behind(event) else {
            // The event is queued with messages, which are not taken during a pause.
            self.high_water = self.high_water.max(self.waiting());
            return Ok(if self.paused { None } else { self.waker.take() });
        };
        self.events.push_back(event);
        self.high_water = self.high_water.max(self.waiting());
        Ok(self.waker.take())
    }

    /// Returns the number of messages of `class` that are queued, being handled, or in flight: counted one by one.
    fn held(&self, class: Class) -> u64 {
        let events = self.events.iter().filter(|event| event.header.class == class).count();
        let current = u64::from(self.current == Some(class));
        (events + self.queue.len_of(class)) as u64 + current + self.in_flight[class as usize]
    }

    const fn begin_handling(&mut self, message: &Message) -> Option<Class> {
        self.taken_out += 1;
        self.current = Some(message.header.class);
        self.current
    }

    /// Counts the outcome of the reader's current message.
    fn count(&mut self, finished: Option<Finished>) {
        if let Some(Finished { class, outcome, age_ns }) = finished {
            self.tallies[class as usize].count(outcome);
            self.ages.count(outcome, age_ns);
            self.current = None;
        }
    }

    /// Fences the current reader; its current message has failed.
    fn next_reader(&mut self) {
        self.epoch += 1;
        if let Some(class) = self.current.take() {
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
    /// Creates an empty mailbox with these bounds for each class.
    #[must_use]
    pub fn new(bounds: impl Into<Bounds>) -> Arc<Self> {
        Self::on_clock(Clock::WALL, bounds)
    }

    /// Same as [`new`](Self::new), for an application with this clock.
    #[must_use]
    pub fn on_clock(clock: Clock, bounds: impl Into<Bounds>) -> Arc<Self> {
        Arc::new(Self { clock, ..Self::with_source(bounds.into(), None) })
    }

    /// Creates the mailbox of a process that hosts one application: its reader takes messages from `source`.
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
            event_waits: None,
            epoch: 0,
            current: None,
            taken_out: 0,
            waiting_since: None,
            in_flight: [0; 3],
            is_remote: false,
            closed: false,
            refuses: false,
            tallies: [Tally::default(); 3],
            ages: MessageAges::default(),
            high_water: 0,
        };
        let records_waits = AtomicBool::new(false);
        Self {
            shared: Mutex::new(shared),
            source,
            refusals: OnceLock::new(),
            records_waits,
            clock: Clock::WALL,
        }
    }

    /// Sets the sink for rejections of unconfirmed messages that were accepted here, reported for `owner`. Set once.
    pub fn report_refusals(&self, owner: Tid, sink: Arc<dyn RefusalSink>) {
        // A second call has no effect.
        let _ = self.refusals.set((owner, sink));
    }

    /// Rejects a message that was accepted. Must be called without a lock.
    pub(super) fn reject(&self, message: Message, why: Rejection) {
        if let Some((owner, sink)) = self.refusals.get()
            && is_reported(&message.header, why)
        {
            sink.refused(*owner, &message.header, why, 1);
        }
        message.reject(why);
    }

    /// Attaches a new incarnation as the reader; the former reader is fenced.
    #[must_use]
    pub fn attach(self: &Arc<Self>) -> MailboxReader {
        let (epoch, former) = {
            let mut shared = lock(&self.shared);
            shared.next_reader();
            (shared.paused, shared.is_remote) = (false, false);
            (shared.epoch, shared.waker.take())
        };
        if let Some(waker) = former {
            waker.wake();
        }
        MailboxReader::new(self.clone(), epoch)
    }

    /// Fences reader number `epoch`, if it is the current one. Queued messages are kept for the next.
    pub(crate) fn detach(&self, epoch: u64) {
        let mut shared = lock(&self.shared);
        if shared.epoch == epoch {
            shared.next_reader();
        }
    }

    /// Rejects all queued and all new messages.
    pub fn close(&self) {
        let (waiting, reader, senders) = {
            let mut shared = lock(&self.shared);
            shared.closed = true;
            let mut waiting = shared.take_events();
            waiting.extend(shared.empty());
            (waiting, shared.waker.take(), shared.awaited_no_more())
        };
        for message in waiting {
            self.reject(message, Rejection::Closed);
        }
        reader.into_iter().for_each(Waker::wake);
        senders.wake();
    }

    /// Rejects all queued and all new messages while the application is down, until
    /// [`accept_again`](Self::accept_again).
    pub fn refuse_while_down(&self) {
        let (waiting, senders) = {
            let mut shared = lock(&self.shared);
            shared.refuses = true;
            (shared.empty(), shared.awaited_no_more())
        };
        for message in waiting {
            self.reject(message, Rejection::Down);
        }
        senders.wake();
    }

    /// Drops the queued events of layers: the incarnation that they were for has ended.
    pub fn forget_events(&self) {
        let (events, waker) = {
            let mut shared = lock(&self.shared);
            (shared.take_events(), shared.event_waits.take())
        };
        for event in events {
            event.reject(Rejection::Down);
        }
        waker.into_iter().for_each(Waker::wake);
    }

    /// Accepts messages again: the application is ready.
    pub fn accept_again(&self) {
        lock(&self.shared).refuses = false;
    }

    /// Accepts messages again, after a [`close`](Self::close).
    pub fn reopen(&self) {
        lock(&self.shared).closed = false;
    }

    /// Returns the number of queued messages.
    #[must_use]
    pub fn depth(&self) -> usize {
        lock(&self.shared).waiting()
    }

    /// Returns the maximum number of messages that were ever queued at once.
    #[must_use]
    pub fn high_water(&self) -> usize {
        lock(&self.shared).high_water
    }

    /// Returns the results of the messages of `class`, and the number that is queued, being handled or in
    /// flight at the same moment: [`Tally::open`] of the former equals the latter.
    #[must_use]
    pub fn account(&self, class: Class) -> (Tally, u64) {
        let shared = lock(&self.shared);
        (shared.tallies[class as usize], shared.held(class))
    }

    /// Returns the results of the messages of `class`.
    #[must_use]
    pub fn tally(&self, class: Class) -> Tally {
        lock(&self.shared).tallies[class as usize]
    }
}

impl Mailbox {
    /// Accepts an event, or calls `is_full` with the lock held.
    fn take_event(&self, event: Message, is_full: impl FnOnce(&mut Shared)) -> Result<(), SubmitError> {
        let mut shared = lock(&self.shared);
        if shared.closed {
            shared.tallies[event.header.class as usize].refused += 1;
            return Err(SubmitError::new(event, Rejection::Closed));
        }
        self.record_wait(&mut shared);
        let waker = shared.submit_event(event).inspect_err(|_| is_full(&mut shared))?;
        drop(shared);
        waker.into_iter().for_each(wakes::wake);
        Ok(())
    }

    /// Accepts a message that is no event.
    fn take_message(&self, message: Message) -> Result<(), SubmitError> {
        let class = message.header.class as usize;
        let (mut expired, mut room) = (Vec::new(), RoomWakers::default());
        let taken = {
            let mut shared = lock(&self.shared);
            if shared.closed {
                shared.tallies[class].refused += 1;
                return Err(SubmitError::new(message, Rejection::Closed));
            }
            if shared.refuses {
                shared.tallies[class].refused += 1;
                return Err(SubmitError::new(message, Rejection::Down));
            }
            if message.receipt.is_some() && message.header.class == Class::Stream {
                shared.tallies[class].refused += 1;
                return Err(SubmitError::new(message, Rejection::Unsupported));
            }
            self.record_wait(&mut shared);
            let mut pushed = shared.queue.push(message);
            if let Err(SubmitError { message, why }) = pushed {
                // An application that waits for its start takes no messages, so expired ones are removed here
                // to make room.
                expired = shared.expire(self.clock.now());
                pushed = if expired.is_empty() {
                    Err(SubmitError::new(message, why))
                } else {
                    room = shared.room_made();
                    shared.queue.push(message)
                };
            }
            match pushed {
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
        // Settled and woken without the lock, so that a notified thread does not wait for it.
        expired.iter_mut().for_each(|message| message.settle(Outcome::Expired));
        room.wake();
        if let Some(waker) = taken? {
            wakes::wake(waker);
        }
        Ok(())
    }
}

impl MessageSink for Mailbox {
    fn submit(&self, message: Message) -> Result<(), SubmitError> {
        if is_event(&message.header) {
            return self.take_event(message, |_| {});
        }
        self.take_message(message)
    }

    fn offer(&self, message: Message, room: Option<&Waker>) -> Result<(), SubmitError> {
        if is_event(&message.header) {
            let class = message.header.class as usize;
            return self.take_event(message, |shared| {
                // The event is offered again.
                shared.tallies[class].refused -= 1;
                shared.event_waits = room.cloned();
            });
        }
        let Err(refused) = self.take_message(message) else { return Ok(()) };
        if refused.why == Rejection::QueueFull {
            let woken = {
                let mut shared = lock(&self.shared);
                // The message is offered again.
                shared.tallies[refused.message.header.class as usize].refused -= 1;
                room.map_or_else(Vec::new, |room| shared.queue.offered(&refused.message, room))
            };
            woken.into_iter().for_each(Waker::wake);
        }
        Err(refused)
    }

    fn cancel(&self, ticket: Ticket) -> bool {
        self.cancel_request(ticket)
    }
}

/// Returns whether a message is an event of one of the node's own layers for an application: nodes, requirements, ends.
#[must_use]
pub fn is_event(header: &Header) -> bool {
    header.source.app.is_layer() && header.source.node == header.destination.node && header.kind.is_user()
}
