//! The reading end of a mailbox with its actor in another process: several messages are in flight at once.
//!
//! Messages in flight count as open until they are settled or given back, so the conservation law of a
//! [`Tally`](super::Tally) holds when the other process dies.

use std::{sync::Arc, task::Waker};

use super::{About, Mailbox, Shared, is_event};
use crate::{
    lock,
    outcome::{Outcome, Rejection},
    wire::{Class, Message},
};

/// Takes the messages of a [`Mailbox`] for a reader in another process. The last reader created is the current
/// one; earlier ones get no messages.
#[derive(Debug)]
pub struct RemoteReader {
    mailbox: Arc<Mailbox>,
    epoch: u64,
}

impl Shared {
    fn count_in_flight(&mut self, message: Option<&Message>) {
        if let Some(message) = message {
            self.in_flight[message.header.class as usize] += 1;
        }
    }

    /// A process that settles more messages than it received must not end the node: the audit reports it.
    fn settle_in_flight(&mut self, class: Class) {
        let in_flight = &mut self.in_flight[class as usize];
        *in_flight = in_flight.saturating_sub(1);
    }
}

impl Mailbox {
    /// Attaches another process as the reader; the former reader is fenced.
    #[must_use]
    pub fn attach_remote(self: &Arc<Self>) -> RemoteReader {
        let epoch = self.attach().epoch();
        lock(&self.shared).is_remote = true;
        RemoteReader { epoch, mailbox: self.clone() }
    }
}

impl RemoteReader {
    /// Takes the next message, if one is queued.
    #[must_use]
    pub fn take(&self) -> Option<Message> {
        let mut shared = lock(&self.mailbox.shared);
        let next = if shared.epoch == self.epoch { shared.next() } else { None };
        let room = next.as_ref().map(|_| shared.room_made());
        shared.count_in_flight(next.as_ref());
        drop(shared);
        room.unwrap_or_default().wake();
        next
    }

    /// Takes the next layer event, if one is queued.
    #[must_use]
    pub fn take_event(&self) -> Option<Message> {
        let mut shared = lock(&self.mailbox.shared);
        let event = if shared.epoch == self.epoch { shared.events.pop_front() } else { None };
        let room = event.as_ref().and_then(|_| shared.event_waits.take());
        shared.count_in_flight(event.as_ref());
        drop(shared);
        room.into_iter().for_each(Waker::wake);
        event
    }

    /// Takes the next event that is [about](About) no node, if one is queued. It passes events about nodes,
    /// and keeps their order.
    #[must_use]
    pub fn take_event_without_node(&self) -> Option<Message> {
        let mut shared = lock(&self.mailbox.shared);
        let is_next = |event: &Message| About::of(&event.header).is_none();
        let at = shared.events.iter().position(is_next).filter(|_| shared.epoch == self.epoch)?;
        let event = shared.events.remove(at);
        let room = shared.event_waits.take();
        shared.count_in_flight(event.as_ref());
        drop(shared);
        room.into_iter().for_each(Waker::wake);
        event
    }

    /// Settles a message in flight of this class with its outcome.
    pub fn settle(&self, class: Class, outcome: Outcome) {
        let mut shared = lock(&self.mailbox.shared);
        shared.settle_in_flight(class);
        shared.tallies[class as usize].count(outcome);
    }

    /// Counts a message in flight of this class that a newer value replaced.
    pub fn supersede(&self, class: Class) {
        let mut shared = lock(&self.mailbox.shared);
        shared.settle_in_flight(class);
        shared.tallies[class as usize].superseded += 1;
    }

    /// Gives back messages in flight that were never handled, oldest first: they are the next to be taken, in the
    /// same order. Layers' events were for the incarnation that ended; they are dropped.
    pub fn give_back(&self, in_flight: Vec<Message>) {
        let mut refused = Vec::new();
        let waker = {
            let mut shared = lock(&self.mailbox.shared);
            let refuses = match (shared.closed, shared.refuses) {
                (true, _) => Some(Rejection::Closed),
                (false, true) => Some(Rejection::Down),
                (false, false) => None,
            };
            for message in in_flight.into_iter().rev() {
                let class = message.header.class as usize;
                shared.settle_in_flight(message.header.class);
                if let Some(why) = refuses.or_else(|| is_event(&message.header).then_some(Rejection::Down)) {
                    shared.tallies[class].rejected += 1;
                    refused.push((message, why));
                } else if shared.queue.put_back(message).is_some() {
                    shared.tallies[class].superseded += 1;
                }
            }
            shared.high_water = shared.high_water.max(shared.waiting());
            shared.waker.take()
        };
        // Notified without the lock, so that a notified thread does not wait for it.
        for (message, why) in refused {
            self.mailbox.reject(message, why);
        }
        waker.into_iter().for_each(Waker::wake);
    }
}

#[cfg(test)]
mod tests {
    use bytes::Bytes;

    use super::*;
    use crate::{
        router::MessageSink,
        tid::Tid,
        wire::{Header, Kind},
    };

    fn message(class: Class, sequence: u64) -> Message {
        let mut header = Header::new(Kind::named("test"), Tid::NONE, Tid::NONE);
        (header.class, header.sequence) = (class, sequence);
        Message::new(header, Bytes::new())
    }

    fn sequences(reader: &RemoteReader) -> Vec<u64> {
        std::iter::from_fn(|| reader.take()).map(|message| message.header.sequence).collect()
    }

    #[test]
    fn returned_messages_come_first_and_in_order() {
        let mailbox = Mailbox::new(4);
        for number in 1..=4 {
            mailbox.submit(message(Class::Bulk, number)).unwrap();
        }
        let first = mailbox.attach_remote();
        let in_flight: Vec<_> = (0..3).filter_map(|_| first.take()).collect();
        let mut in_flight = in_flight.into_iter();
        drop(in_flight.next());
        first.settle(Class::Bulk, Outcome::Failed);
        first.give_back(in_flight.collect());
        let second = mailbox.attach_remote();
        assert!(first.take().is_none(), "the former reader is fenced off");
        assert_eq!(sequences(&second), [2, 3, 4]);
        let tally = mailbox.tally(Class::Bulk);
        assert_eq!((tally.taken, tally.failed, tally.open()), (4, 1, 3));
        assert_eq!(mailbox.account(Class::Bulk), (tally, 3), "messages in flight are counted one by one");
    }

    #[test]
    fn newer_stream_value_wins_over_a_returned_one() {
        let mailbox = Mailbox::new(4);
        mailbox.submit(message(Class::Stream, 1)).unwrap();
        let reader = mailbox.attach_remote();
        let older = reader.take().unwrap();
        mailbox.submit(message(Class::Stream, 2)).unwrap();
        reader.give_back(vec![older]);
        assert_eq!(sequences(&reader), [2]);
        assert_eq!(mailbox.tally(Class::Stream).superseded, 1);
    }

    #[test]
    fn return_to_a_mailbox_that_keeps_nothing_is_rejected() {
        for stop in [Mailbox::close, Mailbox::refuse_while_down] {
            let mailbox = Mailbox::new(4);
            mailbox.submit(message(Class::Control, 1)).unwrap();
            let reader = mailbox.attach_remote();
            let in_flight = reader.take().unwrap();
            stop(&mailbox);
            reader.give_back(vec![in_flight]);
            let tally = mailbox.tally(Class::Control);
            assert_eq!((tally.taken, tally.rejected, tally.open()), (1, 1, 0));
            assert_eq!(mailbox.account(Class::Control), (tally, 0));
        }
    }
    #[test]
    fn other_events_pass_events_about_nodes() {
        let event = |sequence, about: Option<About>| {
            let mut event = message(Class::Control, sequence);
            event.header.source.app = crate::tid::AppAddress::SYNC;
            about.iter().for_each(|about| about.write(&mut event.header));
            event
        };
        let node = crate::tid::NodeAddress::new(9);
        let mailbox = Mailbox::new(4);
        let reader = mailbox.attach_remote();
        let submit = |sequence, about| mailbox.submit(event(sequence, about)).is_ok();
        assert!(submit(1, Some(About::End(node))) && submit(2, Some(About::Node(node))));
        assert!(!submit(3, Some(About::End(node))), "half of the places are not for these");
        assert!(submit(4, None) && submit(5, None) && !submit(6, None));
        let next = || reader.take_event_without_node().map(|event| event.header.sequence);
        assert_eq!([next(), next(), next()], [Some(4), Some(5), None]);
        assert_eq!(sequences(&reader), [1, 2]);
    }
}
