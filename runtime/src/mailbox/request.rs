//! The removal of queued requests that were cancelled.

use super::Mailbox;
use crate::{
    lock,
    outcome::{Outcome, Ticket},
};

impl Mailbox {
    /// Removes the request of `ticket`, if it is queued, and ends it as expired. Returns whether it was queued.
    pub(super) fn cancel_request(&self, ticket: Ticket) -> bool {
        let (mut request, room) = {
            let mut shared = lock(&self.shared);
            let Some(request) = shared.queue.take_request(ticket) else { return false };
            shared.tallies[request.header.class as usize].expired += 1;
            (request, shared.room_made())
        };
        // Settled and woken without the lock, so that a notified thread does not wait for it.
        request.settle(Outcome::Expired);
        room.wake();
        true
    }
}

#[cfg(test)]
mod tests {
    use std::task::{Context, Poll};

    use bytes::Bytes;
    use futures_util::task::noop_waker;

    use super::*;
    use crate::{
        mailbox::MailboxReader,
        router::MessageSink,
        tid::Tid,
        wire::{Class, Flags, Header, Kind, Message},
    };

    #[test]
    fn cancelled_request_is_removed_and_counted() {
        let mailbox = Mailbox::new(3);
        let request = |correlation| {
            let mut header = Header::new(Kind::named("test"), Tid::NONE, Tid::NONE);
            (header.flags, header.correlation) = (Flags::ASK, correlation);
            Message::new(header, Bytes::new())
        };
        (1..=3).for_each(|number| mailbox.submit(request(number)).unwrap());
        assert!(mailbox.cancel(request(2).ticket()));
        assert!(!mailbox.cancel(request(2).ticket()), "it is there no more");
        mailbox.submit(request(4)).unwrap();
        let mut reader = mailbox.attach();
        let take = |reader: &mut MailboxReader| reader.poll_take(&mut Context::from_waker(&noop_waker()));
        for number in [1, 3, 4] {
            let Poll::Ready(Some(next)) = take(&mut reader) else { panic!("request {number}") };
            assert_eq!(next.header.correlation, number);
            reader.finish(Outcome::Delivered);
        }
        assert!(take(&mut reader).is_pending());
        let tally = mailbox.tally(Class::Control);
        assert_eq!((tally.taken, tally.delivered, tally.expired, tally.open()), (4, 3, 1, 0));
    }
}
