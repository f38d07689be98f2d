//! The accepting end of a mailbox: takes one message, or several under one lock.

use std::{collections::VecDeque, task::Waker};

use super::{Mailbox, Shared, is_event};
use crate::{
    lock,
    outcome::{Outcome, Rejection, Ticket},
    router::{MessageSink, SubmitError},
    wakes,
    wire::{Class, Message},
};

/// Actions that follow when the lock is released, so that a notified thread does not wait for it.
#[derive(Default)]
struct AfterUnlock {
    /// Messages that have expired in the mailbox.
    expired: Vec<Message>,
    /// The sender of an event that waits for a removal.
    event_waits: Option<Waker>,
    /// The reader, which can take a message.
    reader: Option<Waker>,
}

impl AfterUnlock {
    #[inline]
    fn run(mut self) {
        self.expired.iter_mut().for_each(|message| message.settle(Outcome::Expired));
        self.event_waits.into_iter().for_each(Waker::wake);
        self.reader.into_iter().for_each(wakes::wake);
    }
}

impl Shared {
    /// Records that messages were queued. Returns the waker of the reader, if it can take them.
    #[inline]
    fn queued(&mut self) -> Option<Waker> {
        self.high_water = self.high_water.max(self.waiting());
        if self.paused { None } else { self.waker.take() }
    }

    /// Returns why no message like this one is accepted now, whether or not there is room.
    #[inline]
    fn why_refused(&self, message: &Message) -> Option<Rejection> {
        if self.closed {
            Some(Rejection::Closed)
        } else if self.refuses {
            Some(Rejection::Down)
        } else if message.receipt.is_some() && message.header.class == Class::Stream {
            Some(Rejection::Unsupported)
        } else {
            None
        }
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
        let mut after = AfterUnlock::default();
        let taken = {
            let mut shared = lock(&self.shared);
            let taken = self.accept(&mut shared, message, &mut after);
            if taken.is_ok() {
                after.reader = shared.queued();
            }
            taken
        };
        after.run();
        taken
    }

    /// Accepts messages from the front of `run`, up to the first event, under one lock. Wakes the reader once.
    fn take_run(&self, run: &mut VecDeque<Message>) -> Result<(), SubmitError> {
        let (mut after, mut taken, before) = (AfterUnlock::default(), Ok(()), run.len());
        {
            let mut shared = lock(&self.shared);
            while taken.is_ok()
                && let Some(message) = run.pop_front_if(|message| !is_event(&message.header))
            {
                taken = self.accept(&mut shared, message, &mut after);
            }
            if let Err(SubmitError { message, why: Rejection::QueueFull }) = &taken {
                // The message is offered again.
                shared.tallies[message.header.class as usize].refused -= 1;
            }
            if before - run.len() > usize::from(taken.is_err()) {
                after.reader = shared.queued();
            }
        }
        after.run();
        taken
    }

    /// Queues a message that is no event.
    #[inline]
    fn accept(
        &self,
        shared: &mut Shared,
        message: Message,
        after: &mut AfterUnlock,
    ) -> Result<(), SubmitError> {
        let class = message.header.class as usize;
        if let Some(why) = shared.why_refused(&message) {
            shared.tallies[class].refused += 1;
            return Err(SubmitError::new(message, why));
        }
        if !shared.queue.has_room_for(&message) {
            // An application that waits for its start takes no messages, so expired ones are removed here
            // to make room.
            shared.high_water = shared.high_water.max(shared.waiting());
            let expired = shared.expire(self.clock.now());
            if !expired.is_empty() {
                after.event_waits = after.event_waits.take().or_else(|| shared.event_waits.take());
                after.expired.extend(expired);
            }
        }
        self.record_wait(shared);
        match shared.queue.push(message) {
            Ok(superseded) => {
                shared.tallies[class].taken += 1;
                shared.tallies[class].superseded += u64::from(superseded.is_some());
                Ok(())
            }
            Err(refused) => {
                shared.tallies[class].refused += 1;
                Err(refused)
            }
        }
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
            let waker = {
                let mut shared = lock(&self.shared);
                // The message is offered again.
                shared.tallies[refused.message.header.class as usize].refused -= 1;
                room.and_then(|room| shared.queue.offered(&refused.message, room))
            };
            waker.into_iter().for_each(Waker::wake);
        }
        Err(refused)
    }

    fn offer_run(&self, run: &mut VecDeque<Message>) -> Result<(), SubmitError> {
        loop {
            self.take_run(run)?;
            let Some(event) = run.pop_front() else { return Ok(()) };
            self.offer(event, None)?;
        }
    }

    fn cancel(&self, ticket: Ticket) -> bool {
        self.cancel_request(ticket)
    }
}
