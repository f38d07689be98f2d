//! The reading end of a mailbox whose actor is in another process: several messages are out at once.
//!
//! What is lent stays counted as open until it is settled or given back, so that the conservation law of a
//! [`Tally`](super::Tally) holds across the death of the borrower.

use std::{sync::Arc, task::Waker};

use super::{About, Mailbox, Shared, is_event};
use crate::{
    outcome::{Outcome, Rejection},
    post::lock,
    wire::{Class, Message},
};

/// Lends the messages of a [`Mailbox`]. The latest one made is the present reader; earlier ones get nothing.
#[derive(Debug)]
pub struct Lender {
    mailbox: Arc<Mailbox>,
    epoch: u64,
}

impl Shared {
    fn lends(&mut self, message: Option<&Message>) {
        if let Some(message) = message {
            self.lent[message.header.class as usize] += 1;
        }
    }

    /// A borrower that says more than it was lent must not end the node: the audit shows it.
    fn lent_no_more(&mut self, class: Class) {
        let lent = &mut self.lent[class as usize];
        *lent = lent.saturating_sub(1);
    }
}

impl Mailbox {
    /// Takes over the reading end for a borrower in another process; the former reader is fenced off.
    #[must_use]
    pub fn lend(self: &Arc<Self>) -> Lender {
        let epoch = self.attach().epoch();
        lock(&self.shared).is_lent = true;
        Lender { epoch, mailbox: self.clone() }
    }
}

impl Lender {
    /// The next message, if one waits.
    #[must_use]
    pub fn take(&self) -> Option<Message> {
        let mut shared = lock(&self.mailbox.shared);
        let (next, room) =
            if shared.epoch == self.epoch { (shared.next(), shared.queue.room_made()) } else { (None, None) };
        shared.lends(next.as_ref());
        drop(shared);
        room.into_iter().for_each(Waker::wake);
        next
    }

    /// The next of the layers' events, if one waits.
    #[must_use]
    pub fn take_event(&self) -> Option<Message> {
        let mut shared = lock(&self.mailbox.shared);
        let event = if shared.epoch == self.epoch { shared.events.pop_front() } else { None };
        shared.lends(event.as_ref());
        event
    }

    /// The next of them that is [about](About) no node, if one waits. It passes those that are, whose order stays.
    #[must_use]
    pub fn take_event_about_nobody(&self) -> Option<Message> {
        let mut shared = lock(&self.mailbox.shared);
        let is_next = |event: &Message| About::of(&event.header).is_none();
        let at = shared.events.iter().position(is_next).filter(|_| shared.epoch == self.epoch)?;
        let event = shared.events.remove(at);
        shared.lends(event.as_ref());
        event
    }

    /// A lent message of this class has ended so.
    pub fn settle(&self, class: Class, outcome: Outcome) {
        let mut shared = lock(&self.mailbox.shared);
        shared.lent_no_more(class);
        shared.tallies[class as usize].count(outcome);
    }

    /// A newer value took the place of a lent message of this class.
    pub fn supersede(&self, class: Class) {
        let mut shared = lock(&self.mailbox.shared);
        shared.lent_no_more(class);
        shared.tallies[class as usize].superseded += 1;
    }

    /// Gives back what was lent and never handled, oldest first: it is the next to be taken, in the same order. The
    /// layers' events were for the life that has ended; they are dropped.
    pub fn give_back(&self, lent: Vec<Message>) {
        let mut refused = Vec::new();
        let waker = {
            let mut shared = lock(&self.mailbox.shared);
            let refuses = match (shared.closed, shared.refuses) {
                (true, _) => Some(Rejection::Closed),
                (false, true) => Some(Rejection::Down),
                (false, false) => None,
            };
            for message in lent.into_iter().rev() {
                let class = message.header.class as usize;
                shared.lent_no_more(message.header.class);
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
        // Told outside the lock, so that nobody who is told runs into it.
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
        router::Outlet,
        tid::Tid,
        wire::{Header, Kind},
    };

    fn message(class: Class, sequence: u64) -> Message {
        let mut header = Header::new(Kind::named("test"), Tid::NONE, Tid::NONE);
        (header.class, header.sequence) = (class, sequence);
        Message::new(header, Bytes::new())
    }

    fn sequences(lender: &Lender) -> Vec<u64> {
        std::iter::from_fn(|| lender.take()).map(|message| message.header.sequence).collect()
    }

    #[test]
    fn what_is_given_back_comes_first_and_in_order_to_the_next_reader() {
        let mailbox = Mailbox::new(4);
        for number in 1..=4 {
            mailbox.submit(message(Class::Bulk, number)).unwrap();
        }
        let first = mailbox.lend();
        let lent: Vec<_> = (0..3).filter_map(|_| first.take()).collect();
        let mut lent = lent.into_iter();
        drop(lent.next());
        first.settle(Class::Bulk, Outcome::Failed);
        first.give_back(lent.collect());
        let second = mailbox.lend();
        assert!(first.take().is_none(), "the former reader is fenced off");
        assert_eq!(sequences(&second), [2, 3, 4]);
        let tally = mailbox.tally(Class::Bulk);
        assert_eq!((tally.taken, tally.failed, tally.open()), (4, 1, 3));
        assert_eq!(mailbox.account(Class::Bulk), (tally, 3), "what is lent is counted one by one");
    }

    #[test]
    fn of_a_stream_that_is_given_back_the_newer_value_that_waits_wins() {
        let mailbox = Mailbox::new(4);
        mailbox.submit(message(Class::Stream, 1)).unwrap();
        let lender = mailbox.lend();
        let older = lender.take().unwrap();
        mailbox.submit(message(Class::Stream, 2)).unwrap();
        lender.give_back(vec![older]);
        assert_eq!(sequences(&lender), [2]);
        assert_eq!(mailbox.tally(Class::Stream).superseded, 1);
    }

    #[test]
    fn what_is_given_back_to_a_mailbox_that_keeps_nothing_is_refused() {
        for stop in [Mailbox::close, Mailbox::refuse_while_away] {
            let mailbox = Mailbox::new(4);
            mailbox.submit(message(Class::Control, 1)).unwrap();
            let lender = mailbox.lend();
            let lent = lender.take().unwrap();
            stop(&mailbox);
            lender.give_back(vec![lent]);
            let tally = mailbox.tally(Class::Control);
            assert_eq!((tally.taken, tally.rejected, tally.open()), (1, 1, 0));
            assert_eq!(mailbox.account(Class::Control), (tally, 0));
        }
    }
    #[test]
    fn events_about_nodes_leave_room_for_others_which_pass_them_and_keep_their_order() {
        let event = |sequence, about: Option<About>| {
            let mut event = message(Class::Control, sequence);
            event.header.source.app = crate::tid::AppAddress::SYNC;
            about.iter().for_each(|about| about.write(&mut event.header));
            event
        };
        let node = crate::tid::NodeAddress::new(9);
        let mailbox = Mailbox::new(4);
        let lender = mailbox.lend();
        let submit = |sequence, about| mailbox.submit(event(sequence, about)).is_ok();
        assert!(submit(1, Some(About::End(node))) && submit(2, Some(About::Node(node))));
        assert!(!submit(3, Some(About::End(node))), "half of the places are not for these");
        assert!(submit(4, None) && submit(5, None) && !submit(6, None));
        let next = || lender.take_event_about_nobody().map(|event| event.header.sequence);
        assert_eq!([next(), next(), next()], [Some(4), Some(5), None]);
        assert_eq!(sequences(&lender), [1, 2]);
    }
}
