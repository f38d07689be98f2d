//! The reading end of a mailbox: one message at a time into the hand, and what became of it.

use std::{
    sync::Arc,
    task::{Context, Poll, Waker},
};

use super::Mailbox;
use crate::{
    outcome::Outcome,
    post::lock,
    wire::{Class, Message},
};

/// The reading end of a [`Mailbox`], owned by one incarnation of an actor.
#[derive(Debug)]
pub struct MailboxReader {
    mailbox: Arc<Mailbox>,
    epoch: u64,
    in_hand: Option<Class>,
    finished: Option<(Class, Outcome)>,
}

impl MailboxReader {
    /// Takes the next message into the hand. `None` once the mailbox is closed or a later incarnation reads it.
    pub fn poll_take(&mut self, cx: &mut Context<'_>) -> Poll<Option<Message>> {
        if let Some(source) = &self.mailbox.source {
            let taken = source.poll_take(cx);
            if let Poll::Ready(Some(message)) = &taken {
                self.in_hand = Some(message.header.class);
            }
            return taken;
        }
        let mut shared = lock(&self.mailbox.shared);
        if shared.epoch != self.epoch {
            return Poll::Ready(None);
        }
        shared.count(self.finished.take());
        shared.paused = false;
        if let Some(message) = shared.next() {
            self.in_hand = shared.hands_out(&message);
            let room = shared.queue.room_made();
            drop(shared);
            room.into_iter().for_each(Waker::wake);
            return Poll::Ready(Some(message));
        }
        if shared.closed {
            return Poll::Ready(None);
        }
        shared.waker = Some(cx.waker().clone());
        Poll::Pending
    }

    /// The same for the layers' events alone; everything else is left where it is.
    pub fn poll_event(&mut self, cx: &mut Context<'_>) -> Poll<Option<Message>> {
        if let Some(source) = &self.mailbox.source {
            let taken = source.poll_event(cx);
            if let Poll::Ready(Some(event)) = &taken {
                self.in_hand = Some(event.header.class);
            }
            return taken;
        }
        let mut shared = lock(&self.mailbox.shared);
        if shared.epoch != self.epoch {
            return Poll::Ready(None);
        }
        shared.count(self.finished.take());
        if let Some(event) = shared.events.pop_front() {
            self.in_hand = shared.hands_out(&event);
            return Poll::Ready(Some(event));
        }
        if shared.closed {
            return Poll::Ready(None);
        }
        shared.paused = true;
        shared.waker = Some(cx.waker().clone());
        Poll::Pending
    }

    /// The message in hand has ended so. Counted with the next [`poll_take`](Self::poll_take), under its lock, or when
    /// this reader is dropped.
    pub fn finish(&mut self, outcome: Outcome) {
        let Some(class) = self.in_hand.take() else { return };
        match &self.mailbox.source {
            Some(source) => source.finish(outcome),
            None => self.finished = Some((class, outcome)),
        }
    }
}

impl MailboxReader {
    /// The reader of `mailbox` with this number; its mailbox knows no other from now on.
    pub(super) const fn new(mailbox: Arc<Mailbox>, epoch: u64) -> Self {
        Self { mailbox, epoch, in_hand: None, finished: None }
    }

    /// Counts the message that has ended now, before code runs that may not come back: one that is fenced off in it has
    /// nothing in its hand.
    pub(crate) fn count(&mut self) {
        if self.finished.is_some() {
            let mut shared = lock(&self.mailbox.shared);
            if shared.epoch == self.epoch {
                shared.count(self.finished.take());
            }
        }
    }

    /// Which reader of its mailbox this is.
    pub(crate) const fn epoch(&self) -> u64 {
        self.epoch
    }
}

impl Drop for MailboxReader {
    fn drop(&mut self) {
        if let Some(source) = self.mailbox.source.as_ref().filter(|_| self.in_hand.is_some()) {
            source.finish(Outcome::Failed);
        }
        let mut shared = lock(&self.mailbox.shared);
        if shared.epoch == self.epoch {
            shared.count(self.finished.take());
            shared.count(self.in_hand.take().map(|class| (class, Outcome::Failed)));
        }
    }
}
