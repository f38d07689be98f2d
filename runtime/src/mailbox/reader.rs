//! The reading end of a mailbox: takes one message at a time, and records its outcome.

use std::{
    sync::Arc,
    task::{Context, Poll, Waker},
};

use super::Mailbox;
use crate::{
    lock,
    outcome::Outcome,
    wire::{Class, Message},
};

/// A message that the reader has handled.
#[derive(Clone, Copy, Debug)]
pub(super) struct Finished {
    pub(super) class: Class,
    pub(super) outcome: Outcome,
    /// Its age in nanoseconds when its handler was called, if it is counted.
    pub(super) age_ns: Option<u64>,
}

/// The reading end of a [`Mailbox`], owned by one incarnation of an actor.
#[derive(Debug)]
pub struct MailboxReader {
    mailbox: Arc<Mailbox>,
    epoch: u64,
    current: Option<Class>,
    finished: Option<Finished>,
    /// Whether the last taken message left none behind. A hint, which is checked under the lock.
    seems_empty: bool,
}

impl MailboxReader {
    /// Takes the next message. `None` if the mailbox is closed or a later incarnation reads it.
    pub fn poll_take(&mut self, cx: &mut Context<'_>) -> Poll<Option<Message>> {
        if let Some(source) = &self.mailbox.source {
            let taken = source.poll_take(cx);
            if let Poll::Ready(Some(message)) = &taken {
                self.current = Some(message.header.class);
            }
            return taken;
        }
        let mut shared = lock(&self.mailbox.shared);
        if shared.epoch != self.epoch {
            return Poll::Ready(None);
        }
        shared.count(self.finished.take());
        shared.paused = false;
        let next = shared.next();
        if let Some(message) = &next {
            self.current = shared.begin_handling(message);
            self.seems_empty = shared.waiting() == 0;
            if !self.seems_empty {
                self.mailbox.record_rest(&mut shared);
            }
            let room = shared.room_made();
            drop(shared);
            room.wake();
            return Poll::Ready(next);
        }
        if shared.closed {
            return Poll::Ready(None);
        }
        shared.waker = Some(cx.waker().clone());
        Poll::Pending
    }

    /// Waits for the next message, if none is queued after the last one that was taken; as
    /// [`poll_take`](Self::poll_take) then does. Otherwise returns `Ready`, and `poll_take` is to be called.
    pub(crate) fn poll_idle(&mut self, cx: &mut Context<'_>) -> Poll<()> {
        if !self.seems_empty {
            return Poll::Ready(());
        }
        let mut shared = lock(&self.mailbox.shared);
        if shared.epoch != self.epoch || shared.closed || shared.waiting() > 0 {
            return Poll::Ready(());
        }
        shared.count(self.finished.take());
        shared.paused = false;
        shared.waker = Some(cx.waker().clone());
        Poll::Pending
    }

    /// Takes the next layer event; all other messages stay queued.
    pub fn poll_event(&mut self, cx: &mut Context<'_>) -> Poll<Option<Message>> {
        if let Some(source) = &self.mailbox.source {
            let taken = source.poll_event(cx);
            if let Poll::Ready(Some(event)) = &taken {
                self.current = Some(event.header.class);
            }
            return taken;
        }
        let mut shared = lock(&self.mailbox.shared);
        if shared.epoch != self.epoch {
            return Poll::Ready(None);
        }
        shared.count(self.finished.take());
        if let Some(event) = shared.events.pop_front() {
            self.current = shared.begin_handling(&event);
            self.mailbox.record_rest(&mut shared);
            let room = shared.event_waits.take();
            drop(shared);
            room.into_iter().for_each(Waker::wake);
            return Poll::Ready(Some(event));
        }
        if shared.closed {
            return Poll::Ready(None);
        }
        shared.paused = true;
        shared.waker = Some(cx.waker().clone());
        Poll::Pending
    }

    /// Records the outcome of the current message. It is counted with the next
    /// [`poll_take`](Self::poll_take), under its lock, or when this reader is dropped.
    #[inline]
    pub fn finish(&mut self, outcome: Outcome) {
        self.finish_aged(outcome, None);
    }

    /// Same as [`finish`](Self::finish), for a message of this age in nanoseconds, by which it is counted if delivered.
    #[inline]
    pub(crate) fn finish_aged(&mut self, outcome: Outcome, age_ns: Option<u64>) {
        let Some(class) = self.current.take() else { return };
        match &self.mailbox.source {
            Some(source) => source.finish(outcome),
            None => self.finished = Some(Finished { class, outcome, age_ns }),
        }
    }
}

impl MailboxReader {
    /// Creates the reader of `mailbox` with this number; it is the only one from now on.
    pub(super) const fn new(mailbox: Arc<Mailbox>, epoch: u64) -> Self {
        Self { mailbox, epoch, current: None, finished: None, seems_empty: false }
    }

    /// Counts the ended message now, before code runs that may not return: a reader that is fenced during
    /// that code has no current message.
    #[inline]
    pub(crate) fn count(&mut self) {
        if self.finished.is_some() {
            let mut shared = lock(&self.mailbox.shared);
            if shared.epoch == self.epoch {
                shared.count(self.finished.take());
            }
        }
    }

    /// Returns the number of this reader at its mailbox.
    pub(crate) const fn epoch(&self) -> u64 {
        self.epoch
    }
}

impl Drop for MailboxReader {
    fn drop(&mut self) {
        if let Some(source) = self.mailbox.source.as_ref().filter(|_| self.current.is_some()) {
            source.finish(Outcome::Failed);
        }
        let mut shared = lock(&self.mailbox.shared);
        if shared.epoch == self.epoch {
            shared.count(self.finished.take());
            let failed = |class| Finished { class, outcome: Outcome::Failed, age_ns: None };
            shared.count(self.current.take().map(failed));
        }
    }
}
