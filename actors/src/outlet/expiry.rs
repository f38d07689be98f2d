//! What loses its use while it waits, and outcomes that do not come any more.

use std::time::Duration;

use sinew_runtime::{
    outcome::{Outcome, Ticket},
    time::Time,
    wire::Message,
};

use super::{Socket, after::After, half::Half, outstanding::owed_by};

/// Time after a sent message's time to live in which its outcome may still come.
pub(super) const OUTCOME_GRACE: Duration = Duration::from_secs(1);

impl<S: Socket> Half<S> {
    pub(super) fn expired(&mut self, message: Message, after: &mut After) {
        self.counts.expired += 1;
        after.settle(message.receipt.map(|receipt| (receipt, Outcome::Expired)));
        self.receipts.fewer_are_open(after);
    }

    /// Nobody waits any more for the reply to this request: its time is over, if it has not been begun. Returns whether it waited here.
    pub(super) fn cancel(&mut self, ticket: Ticket, after: &mut After) -> bool {
        let is_interrupted = self.interrupted.as_ref().is_some_and(|message| message.is_request(ticket));
        let waited = if is_interrupted { self.interrupted.take() } else { self.queue.take_request(ticket) };
        let Some(message) = waited.or_else(|| self.take_request_in_line(ticket)) else { return false };
        after.room.extend(self.queue.room_made());
        self.receipts.waits_no_more(owed_by(&message));
        self.expired(message, after);
        true
    }

    /// Returns whether anything is left that can expire, or an outcome that may be overdue one day.
    pub(super) fn expire(&mut self, now: Time, after: &mut After) -> bool {
        if now > self.next_expiry {
            self.expire_waiting(now, after);
        }
        self.next_expiry != Time::MAX || self.receipts.len() > 0
    }

    fn expire_waiting(&mut self, now: Time, after: &mut After) {
        self.next_expiry = Time::MAX;
        self.expire_lines(now, after);
        if let Some(message) = self.interrupted.take() {
            self.interrupted = self.keep_or_expire(message, now, after);
        }
        for message in self.queue.take_expired(now) {
            self.receipts.waits_no_more(owed_by(&message));
            self.expired(message, after);
        }
        self.next_expiry = self.next_expiry.min(self.queue.next_expiry());
    }

    fn keep_or_expire(&mut self, message: Message, now: Time, after: &mut After) -> Option<Message> {
        if message.header.is_expired(now) {
            self.receipts.waits_no_more(owed_by(&message));
            self.expired(message, after);
            return None;
        }
        self.next_expiry = self.next_expiry.min(message.header.expiry());
        Some(message)
    }
}
