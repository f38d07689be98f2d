//! What came for applications that take nothing now: a line for each, and how it goes on.

use std::task::Waker;

use sinew_runtime::{
    outcome::{Outcome, Rejection, Ticket},
    router::{Refused, Router},
    time::Time,
    wire::Message,
};

use super::{super::arrivals::End, Inbox, LINES_MAX, Offered, Way};

/// Messages of one line that are offered before others have their turn.
const OFFERS_PER_TURN: usize = 256;
/// Messages of all lines that are settled as expired before.
const EXPIRED_PER_TURN: usize = 256;

impl Way {
    /// Puts a message behind what waits for its destination; if that is held from now on, the peer is told so at once. Returns whether
    /// it is.
    ///
    /// # Errors
    /// The message: there is no room, or the lines were [abandoned](Self::abandon_lines).
    pub(in crate::gncl) fn put_in_line(&self, key: u64, message: Message) -> Result<bool, Message> {
        let bytes = message.size();
        let put = {
            let Inbox { shelf, arrivals, is_abandoned, .. } = &mut *self.inbox();
            if *is_abandoned {
                return Err(message);
            }
            let (before, has_no_line) = (shelf.change(), shelf.has_no_line_for(key));
            let put = shelf.put(key, message, bytes);
            if put.is_ok() {
                arrivals.put_away();
            }
            put.map(|()| shelf.change() != before).map_err(|message| (message, has_no_line))
        };
        match put {
            Ok(is_news) => {
                self.owes_less();
                if is_news {
                    // spec: CREDIT-2
                    self.acknowledge();
                }
                Ok(is_news)
            }
            Err((message, has_no_line)) => {
                if has_no_line {
                    self.count_too_many_lines();
                }
                Err(message)
            }
        }
    }

    /// Gives up what waits here of a life that is over: it has failed, and nothing more waits.
    pub(in crate::gncl) fn abandon_lines(&self) {
        let abandoned = {
            let Inbox { shelf, arrivals, is_abandoned, .. } = &mut *self.inbox();
            *is_abandoned = true;
            let abandoned = shelf.take_useless(|_| true);
            for _ in &abandoned {
                arrivals.take_again();
                arrivals.end(End::Failed);
            }
            abandoned
        };
        // Nobody is told anything with the lock in hand.
        for mut message in abandoned {
            message.settle(Outcome::Failed);
        }
        self.owes_less();
    }

    fn count_too_many_lines(&self) {
        let detail = format!(
            "{LINES_MAX} applications here take nothing of what node {} sends, and one more is full: what comes for that one is refused \
             (QueueFull) until one of them takes again; what they wait for says `sinew why`",
            self.ends.node
        );
        self.told.refusals.count(Time::now(), "too many full applications", &detail);
    }

    /// Takes a request out of its line that nobody waits for any more; if its destination is held no more, the peer is told so.
    pub(in crate::gncl) fn take_back(&self, line: u64, ticket: Ticket) -> Option<Message> {
        let (request, is_news) = {
            let Inbox { shelf, arrivals, .. } = &mut *self.inbox();
            let before = shelf.change();
            let request = shelf.take_back(line, |message| message.is_request(ticket))?;
            arrivals.take_again();
            arrivals.end(End::Expired);
            (request, shelf.change() != before)
        };
        self.owes_less();
        if is_news || self.owes_room() {
            // spec: CREDIT-2
            self.acknowledge();
        }
        Some(request)
    }

    /// Offers what waits for applications here to them again, but for lines that are `is_early`; `room` is woken when one of them takes
    /// more. Returns how far that came.
    pub(in crate::gncl) fn offer_again(
        &self,
        now: Time,
        router: &Router,
        room: &Waker,
        is_early: impl Fn(u64) -> bool,
    ) -> Offered {
        let (has_fewer, expired) = self.expire_lines(now);
        let held = self.inbox().shelf.held().into_iter().filter(|key| !is_early(*key));
        let lines: Vec<_> = held.map(|key| self.offer_line(now, key, router, room)).collect();
        if has_fewer || !lines.is_empty() {
            self.owes_less();
        }
        if has_fewer || lines.contains(&Offered::All) || self.owes_room() {
            // spec: CREDIT-2
            self.acknowledge();
        }
        lines.into_iter().fold(expired, Offered::max)
    }

    /// Whether there is much more room than the peer knows of.
    fn owes_room(&self) -> bool {
        let Inbox { receiving, shelf, .. } = &*self.inbox();
        receiving.owes_room(shelf.room(self.window, self.longest))
    }

    /// Settles what has expired in the lines, also behind a message that may wait longer. Returns whether somebody is held no more, and
    /// how far that came.
    fn expire_lines(&self, now: Time) -> (bool, Offered) {
        let (expired, has_fewer, is_all) = {
            let Inbox { shelf, arrivals, .. } = &mut *self.inbox();
            let before = shelf.change();
            let expired = shelf.take_expired(now, EXPIRED_PER_TURN);
            for _ in &expired {
                arrivals.take_again();
                arrivals.end(End::Expired);
            }
            (expired, shelf.change() != before, shelf.next_expiry() >= now)
        };
        // Nobody is told anything with the lock in hand.
        for mut message in expired {
            message.settle(Outcome::Expired);
        }
        (has_fewer, if is_all { Offered::All } else { Offered::Turn })
    }

    /// Offers what waits in one line until its destination takes no more.
    fn offer_line(&self, now: Time, key: u64, router: &Router, room: &Waker) -> Offered {
        for _ in 0..OFFERS_PER_TURN {
            let Some((mut message, bytes)) = self.inbox().offer(key) else { return Offered::Full };
            let hand = self.hand();
            // Nobody is told anything with the lock in hand.
            if message.header.is_expired(now) {
                message.settle(Outcome::Expired);
                hand.ends(End::Expired);
            } else {
                match router.offer(message, Some(room)) {
                    Ok(()) => hand.ends(End::HandedOn),
                    Err(Refused { message, why: Rejection::QueueFull }) => {
                        let Some(message) = self.inbox().put_back(key, message, bytes) else {
                            hand.empty();
                            return Offered::Full;
                        };
                        router.refuse_arrived(Refused::new(message, Rejection::QueueFull));
                        hand.ends(End::Refused);
                        return Offered::All;
                    }
                    Err(refused) => {
                        router.refuse_arrived(refused);
                        hand.ends(End::Refused);
                    }
                }
            }
            if self.inbox().shelf.taken(key) {
                return Offered::All;
            }
        }
        Offered::Turn
    }
}
