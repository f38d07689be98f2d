//! Messages for applications that accept nothing now: one queue for each destination, and its delivery.

use std::task::Waker;

use sinew_runtime::{
    outcome::{Outcome, Rejection, Ticket},
    router::{Router, SubmitError},
    time::Time,
    wire::Message,
};

use super::{super::receive_counters::Disposition, Inbox, Offered, PeerSession, QUEUES_MAX};

/// Messages of one queue that are offered before other tasks run.
const OFFERS_PER_TURN: usize = 256;
/// Messages of all queues that are settled as expired before other tasks run.
const EXPIRED_PER_TURN: usize = 256;

impl PeerSession {
    /// Appends a message to its destination's queue. If the destination becomes held by this, an ACK notifies
    /// the peer at once. Returns whether it does.
    ///
    /// # Errors
    /// Returns the message if there is no room, or if the queues were [abandoned](Self::abandon_queues).
    pub(crate) fn enqueue(&self, key: u64, message: Message) -> Result<bool, Message> {
        let bytes = message.size();
        let put = {
            let Inbox { backlog, counters, is_abandoned, .. } = &mut *self.inbox();
            if *is_abandoned {
                return Err(message);
            }
            let (before, has_no_queue) = (backlog.change(), backlog.lacks_queue_for(key));
            let put = backlog.put(key, message, bytes);
            if put.is_ok() {
                counters.suspend();
            }
            put.map(|()| backlog.change() != before).map_err(|message| (message, has_no_queue))
        };
        match put {
            Ok(is_news) => {
                self.notify_fewer_outstanding();
                if is_news {
                    // spec: CREDIT-2
                    self.acknowledge();
                }
                Ok(is_news)
            }
            Err((message, has_no_queue)) => {
                if has_no_queue {
                    self.count_too_many_queues();
                }
                Err(message)
            }
        }
    }

    /// Drops the waiting messages of an ended incarnation as failed; nothing may wait any more.
    pub(crate) fn abandon_queues(&self) {
        let abandoned = {
            let Inbox { backlog, counters, is_abandoned, .. } = &mut *self.inbox();
            *is_abandoned = true;
            let abandoned = backlog.take_useless(|_| true);
            for _ in &abandoned {
                counters.resume();
                counters.finish(Disposition::Failed);
            }
            abandoned
        };
        // Receipts are settled without the lock.
        for mut message in abandoned {
            message.settle(Outcome::Failed);
        }
        self.notify_fewer_outstanding();
    }

    fn count_too_many_queues(&self) {
        let detail = format!(
            "{QUEUES_MAX} applications of this node accept no messages of node {}, and one more is full: its messages are rejected \
             (QueueFull) until one of them accepts again; run `sinew why` for details",
            self.parameters.node
        );
        self.notifiers.refusals.count(Time::now(), "too many full applications", &detail);
    }

    /// Removes a cancelled request from its queue. If its destination is no longer held, an ACK notifies the peer.
    pub(crate) fn cancel_queued(&self, queue: u64, ticket: Ticket) -> Option<Message> {
        let (request, is_news) = {
            let Inbox { backlog, counters, .. } = &mut *self.inbox();
            let before = backlog.change();
            let request = backlog.take_back(queue, |message| message.is_request(ticket))?;
            counters.resume();
            counters.finish(Disposition::Expired);
            (request, backlog.change() != before)
        };
        self.notify_fewer_outstanding();
        if is_news || self.must_announce_more_room() {
            // spec: CREDIT-2
            self.acknowledge();
        }
        Some(request)
    }

    /// Offers waiting messages to applications again, except for queues that satisfy `is_early`. `room` is
    /// woken when one of them accepts more. Returns the result of the offers.
    pub(crate) fn offer_again(
        &self,
        now: Time,
        router: &Router,
        room: &Waker,
        is_early: impl Fn(u64) -> bool,
    ) -> Offered {
        let (has_fewer, expired) = self.expire_queued(now);
        let held = self.inbox().backlog.held().into_iter().filter(|key| !is_early(*key));
        let offers: Vec<_> = held.map(|key| self.offer_queue(now, key, router, room)).collect();
        if has_fewer || !offers.is_empty() {
            self.notify_fewer_outstanding();
        }
        if has_fewer || offers.contains(&Offered::All) || self.must_announce_more_room() {
            // spec: CREDIT-2
            self.acknowledge();
        }
        offers.into_iter().fold(expired, Offered::max)
    }

    /// Whether there is much more room than was announced to the peer.
    fn must_announce_more_room(&self) -> bool {
        let Inbox { receiving, backlog, .. } = &*self.inbox();
        receiving.must_announce_room(backlog.room(self.window, self.longest))
    }

    /// Settles expired messages in the queues, also those behind a message that may wait longer. Returns
    /// whether a destination is no longer held, and whether all expired ones were settled.
    fn expire_queued(&self, now: Time) -> (bool, Offered) {
        let (expired, has_fewer, is_all) = {
            let Inbox { backlog, counters, .. } = &mut *self.inbox();
            let before = backlog.change();
            let expired = backlog.take_expired(now, EXPIRED_PER_TURN);
            for _ in &expired {
                counters.resume();
                counters.finish(Disposition::Expired);
            }
            (expired, backlog.change() != before, backlog.next_expiry() >= now)
        };
        // Receipts are settled without the lock.
        for mut message in expired {
            message.settle(Outcome::Expired);
        }
        (has_fewer, if is_all { Offered::All } else { Offered::Turn })
    }

    /// Offers the messages of one queue until its destination accepts no more.
    fn offer_queue(&self, now: Time, key: u64, router: &Router, room: &Waker) -> Offered {
        for _ in 0..OFFERS_PER_TURN {
            let Some((mut message, bytes)) = self.inbox().offer(key) else { return Offered::Full };
            let guard = self.processing_guard();
            // Receipts are settled without the lock.
            if message.header.is_expired(now) {
                message.settle(Outcome::Expired);
                guard.finish(Disposition::Expired);
            } else {
                match router.offer(message, Some(room)) {
                    Ok(()) => guard.finish(Disposition::Forwarded),
                    Err(SubmitError { message, why: Rejection::QueueFull }) => {
                        let Some(message) = self.inbox().put_back(key, message, bytes) else {
                            guard.release();
                            return Offered::Full;
                        };
                        router.refuse_arrived(SubmitError::new(message, Rejection::QueueFull));
                        guard.finish(Disposition::Refused);
                        return Offered::All;
                    }
                    Err(refused) => {
                        router.refuse_arrived(refused);
                        guard.finish(Disposition::Refused);
                    }
                }
            }
            if self.inbox().backlog.taken(key) {
                return Offered::All;
            }
        }
        Offered::Turn
    }
}
