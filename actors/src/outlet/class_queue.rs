//! Stand-in for `sinew_runtime::mailbox::ClassQueue` until that is merged; then this file goes.

use std::collections::VecDeque;

use sinew_runtime::{
    outcome::Rejection,
    router::Refused,
    wire::{Class, Message},
};

/// A bounded queue for each class: Control first, then Stream with the newest value winning, then Bulk.
#[derive(Debug)]
pub(crate) struct ClassQueue {
    capacity: usize,
    control: VecDeque<Message>,
    stream: VecDeque<Message>,
    bulk: VecDeque<Message>,
}

impl ClassQueue {
    /// An empty queue of at most `capacity` messages of each class.
    pub(crate) const fn new(capacity: usize) -> Self {
        Self { capacity, control: VecDeque::new(), stream: VecDeque::new(), bulk: VecDeque::new() }
    }

    /// Takes a message; returns the one that it supersedes.
    ///
    /// # Errors
    /// The message, if its class is full.
    pub(crate) fn push(&mut self, mut message: Message) -> Result<Option<Message>, Refused> {
        let queue = match message.header.class {
            Class::Control => &mut self.control,
            Class::Stream => &mut self.stream,
            Class::Bulk => &mut self.bulk,
        };
        if message.header.class == Class::Stream
            && let Some(older) = queue.iter_mut().find(|older| is_same_stream(older, &message))
        {
            std::mem::swap(older, &mut message);
            return Ok(Some(message));
        }
        if queue.len() >= self.capacity {
            return Err(Refused::new(message, Rejection::QueueFull));
        }
        queue.push_back(message);
        Ok(None)
    }

    /// The most urgent message.
    pub(crate) fn pop(&mut self) -> Option<Message> {
        self.control.pop_front().or_else(|| self.stream.pop_front()).or_else(|| self.bulk.pop_front())
    }

    /// Messages in all classes.
    pub(crate) fn len(&self) -> usize {
        self.control.len() + self.stream.len() + self.bulk.len()
    }

    /// Whether nothing waits.
    pub(crate) fn is_empty(&self) -> bool {
        self.len() == 0
    }

    /// Takes everything out, most urgent first.
    pub(crate) fn drain_all(&mut self) -> impl Iterator<Item = Message> {
        self.control.drain(..).chain(self.stream.drain(..)).chain(self.bulk.drain(..))
    }
}

/// Whether both are values of one thing: a queue of a peer carries messages for many destinations, so the destination
/// counts too.
fn is_same_stream(a: &Message, b: &Message) -> bool {
    let key = |m: &Message| (m.header.source, m.header.destination, m.header.kind);
    key(a) == key(b)
}
