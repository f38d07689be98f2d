//! The queue of an outlet, and the amount in it that may move to a [backlog](backlog_key) later. spec:
//! CREDIT-4

use std::{ops::Deref, task::Waker};

use sinew_runtime::{
    mailbox::ClassQueue,
    outcome::{Outcome, Ticket},
    router::SubmitError,
    time::Time,
    wire::{Class, Kind, Message},
};

use super::{outcomes, unsent::backlog_key};
use crate::Window;

/// An empty amount.
const NONE: Window = Window { messages: 0, bytes: 0 };

/// A queue that counts the messages in it that may move to the backlog. All changes of the queue are made
/// here.
pub(super) struct SendQueue {
    queue: ClassQueue,
    holdable: Window,
    outcomes: usize,
}

impl SendQueue {
    /// Wraps an empty queue.
    pub(super) const fn new(queue: ClassQueue) -> Self {
        Self { queue, holdable: NONE, outcomes: 0 }
    }

    /// Returns the amount that may move to the backlog: messages, and bytes of their payloads.
    pub(super) const fn holdable(&self) -> Window {
        self.holdable
    }

    /// Returns the number of queued outcomes.
    pub(super) const fn outcomes(&self) -> usize {
        self.outcomes
    }

    /// Adds an outcome to the last queued message of Control, if [`extend`](outcomes::extend) does. Returns whether it
    /// was added.
    pub(super) fn extend_outcome(&mut self, ticket: Ticket, outcome: Outcome, max: usize) -> bool {
        let last = self.queue.last_mut(Class::Control);
        let is_added = last.is_some_and(|last| outcomes::extend(last, ticket, outcome, max));
        self.outcomes += usize::from(is_added);
        is_added
    }

    fn add(&mut self, Share { holdable: Window { messages, bytes }, outcomes }: Share) {
        self.holdable.messages += messages;
        self.holdable.bytes += bytes;
        self.outcomes += outcomes;
    }

    fn take(&mut self, message: &Message) {
        let Share { holdable: Window { messages, bytes }, outcomes } = share_of(message);
        self.holdable.messages -= messages;
        self.holdable.bytes -= bytes;
        self.outcomes -= outcomes;
    }

    pub(super) fn push(&mut self, message: Message) -> Result<Option<Message>, SubmitError> {
        let share = share_of(&message);
        // The superseded message is of class Stream, as is `message`. Stream messages never move to the
        // backlog.
        let superseded = self.queue.push(message)?;
        self.add(share);
        Ok(superseded)
    }

    pub(super) fn push_beyond(&mut self, message: Message) {
        self.add(share_of(&message));
        self.queue.push_beyond(message);
    }

    pub(super) fn put_back(&mut self, message: Message) -> Option<Message> {
        let share = share_of(&message);
        let superseded = self.queue.put_back(message);
        if superseded.is_none() {
            self.add(share);
        }
        superseded
    }

    pub(super) fn pop(&mut self) -> Option<Message> {
        self.queue.pop().inspect(|message| self.take(message))
    }

    pub(super) fn pop_if(&mut self, class: Class, is_it: impl FnOnce(&Message) -> bool) -> Option<Message> {
        self.queue.pop_if(class, is_it).inspect(|message| self.take(message))
    }

    pub(super) fn take_request(&mut self, ticket: Ticket) -> Option<Message> {
        self.queue.take_request(ticket).inspect(|message| self.take(message))
    }

    pub(super) fn take_expired(&mut self, now: Time) -> Vec<Message> {
        let expired = self.queue.take_expired(now);
        expired.iter().for_each(|message| self.take(message));
        expired
    }

    pub(super) fn drain_all(&mut self) -> impl Iterator<Item = Message> + use<> {
        (self.holdable, self.outcomes) = (NONE, 0);
        self.queue.drain_all()
    }

    pub(super) fn offered(&mut self, message: &Message, room: &Waker) -> Vec<Waker> {
        self.queue.offered(message, room)
    }

    #[inline]
    pub(super) fn room_made(&mut self) -> Vec<Waker> {
        self.queue.room_made()
    }

    pub(super) fn awaited_no_more(&mut self) -> Vec<Waker> {
        self.queue.awaited_no_more()
    }
}

impl Deref for SendQueue {
    type Target = ClassQueue;

    fn deref(&self) -> &ClassQueue {
        &self.queue
    }
}

/// The amount that one message adds to the counters.
struct Share {
    holdable: Window,
    outcomes: usize,
}

fn share_of(message: &Message) -> Share {
    let window = Window { messages: 1, bytes: message.payload.len() };
    Share {
        holdable: backlog_key(&message.header).map_or(NONE, |_| window),
        outcomes: match message.header.kind {
            Kind::OUTCOME => outcomes::count(message),
            kind => usize::from(kind == Kind::MEMBERS),
        },
    }
}
