//! What waits in an outlet's queue, and how much of it may come into a [line](line_of) one day. spec: CREDIT-4

use std::{ops::Deref, task::Waker};

use sinew_runtime::{
    mailbox::ClassQueue,
    outcome::Ticket,
    router::Refused,
    time::Time,
    wire::{Class, Kind, Message},
};

use super::held::line_of;
use crate::session::Window;

/// Nothing.
const NONE: Window = Window { messages: 0, bytes: 0 };

/// A queue that knows how much of what waits in it may come into a line. All that changes it is here.
pub(super) struct Waiting {
    queue: ClassQueue,
    for_lines: Window,
    outcomes: usize,
}

impl Waiting {
    /// Of a queue in which nothing waits.
    pub(super) const fn new(queue: ClassQueue) -> Self {
        Self { queue, for_lines: NONE, outcomes: 0 }
    }

    /// How much waits that may come into a line: messages, and bytes of their payloads.
    pub(super) const fn for_lines(&self) -> Window {
        self.for_lines
    }

    /// How many of them are outcomes.
    pub(super) const fn outcomes(&self) -> usize {
        self.outcomes
    }

    fn add(&mut self, Share { for_lines: Window { messages, bytes }, outcomes }: Share) {
        self.for_lines.messages += messages;
        self.for_lines.bytes += bytes;
        self.outcomes += outcomes;
    }

    fn take(&mut self, message: &Message) {
        let Share { for_lines: Window { messages, bytes }, outcomes } = share_of(message);
        self.for_lines.messages -= messages;
        self.for_lines.bytes -= bytes;
        self.outcomes -= outcomes;
    }

    pub(super) fn push(&mut self, message: Message) -> Result<Option<Message>, Refused> {
        let share = share_of(&message);
        // What it takes the place of is of class Stream, as it is itself: of these none comes into a line.
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
        (self.for_lines, self.outcomes) = (NONE, 0);
        self.queue.drain_all()
    }

    pub(super) fn offered(&mut self, message: &Message, room: &Waker) -> Option<Waker> {
        self.queue.offered(message, room)
    }

    pub(super) fn room_made(&mut self) -> Option<Waker> {
        self.queue.room_made()
    }

    pub(super) fn awaited_no_more(&mut self) -> Option<Waker> {
        self.queue.awaited_no_more()
    }
}

impl Deref for Waiting {
    type Target = ClassQueue;

    fn deref(&self) -> &ClassQueue {
        &self.queue
    }
}

/// What a message counts for.
struct Share {
    for_lines: Window,
    outcomes: usize,
}

fn share_of(message: &Message) -> Share {
    let window = Window { messages: 1, bytes: message.payload.len() };
    Share {
        for_lines: line_of(&message.header).map_or(NONE, |_| window),
        outcomes: usize::from(matches!(message.header.kind, Kind::OUTCOME | Kind::MEMBERS)),
    }
}
