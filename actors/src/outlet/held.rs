//! What waits for destinations that take nothing now, so that what is for others passes it. spec: CREDIT-3
//!
//! What is taken is never given up for want of room: what was in the queue when its destination became held moves to that one's line,
//! whatever the bounds of lines. So that destinations that are held one after the other do not each bring a whole queue there, the queue takes
//! less as long as there is more in lines than they may hold. spec: CREDIT-4

use sinew_runtime::{
    outcome::{Rejection, Ticket},
    router::Refused,
    tid::AppAddress,
    time::Time,
    wire::{Class, Flags, Header, Kind, Message},
};

use super::{OutletLimits, Socket, after::After, batch::SHORT, half::Half, outstanding::owed_by};
use crate::session::{ShelfLimits, Turn, Window};

/// What waits in lines at the sender: as many lines as a receiver has. In messages the bound of a session's queue holds, and a quarter of it
/// for each line.
pub(super) const LIMITS_OF_LINES: ShelfLimits =
    ShelfLimits { lines: 256, line_messages: 0, line_bytes: 1 << 20, messages: 0, bytes: 4 << 20 };

/// Each of them has the queue's bounds for itself.
const CLASSES: usize = 3;

/// What lines that hold so much `beyond` their bounds leave of twice the queue's `bound`.
const fn left_beside(beyond: usize, bound: usize) -> usize {
    bound.saturating_mul(2).saturating_sub(beyond)
}

/// How much of that the queue may hold: half, so that each further destination brings less; and always a little, at `least` this, for those
/// that take something.
fn room_of(left: usize, bound: usize, least: usize) -> usize {
    (left / 2).max(bound / LIMITS_OF_LINES.lines).max(least)
}

/// The name of a destination that may be held, by class: an application's mailbox, and not where the newest value is all that
/// waits.
pub(crate) fn line_of(header: &Header) -> Option<u64> {
    let is_for_a_mailbox = header.destination.is_single()
        && !header.destination.app.is_layer()
        // One that waits for an answer may take nothing else before it.
        && !header.flags.has(Flags::OUTCOME)
        && !header.flags.has(Flags::REPLY)
        // It takes a message back that may wait in the line.
        && header.kind != Kind::CANCEL;
    match header.class {
        Class::Control | Class::Bulk if is_for_a_mailbox => {
            Some((header.class as u64) << 32 | u64::from(header.destination.app.bits()))
        }
        Class::Control | Class::Bulk | Class::Stream => None,
    }
}

/// The application that a line is for.
pub(crate) const fn destination_of(line: u64) -> AppAddress {
    // Its address is the lower half.
    AppAddress::new(line as u32)
}

impl<S: Socket> Half<S> {
    /// The line that this message belongs into, if its destination is held.
    pub(super) fn held_line(&self, header: &Header) -> Option<u64> {
        let session = self.session.as_ref().filter(|session| session.held.holds_any())?;
        line_of(header).filter(|key| session.held.holds(*key))
    }

    /// Messages in lines.
    pub(super) fn in_lines(&self) -> usize {
        self.session.as_ref().map_or(0, |session| session.held.messages())
    }

    /// Whether what waits in lines leaves room in the queue for this message, which may come into a line one day. spec: CREDIT-4
    pub(super) fn has_room_beside_lines(&self, message: &Message) -> bool {
        let beyond = self.session.as_ref().and_then(|session| session.held.beyond());
        let Some(beyond) = beyond.filter(|_| line_of(&message.header).is_some()) else { return true };
        let OutletLimits { queue_capacity, queue_bytes, payload_max, .. } = self.limits;
        let (Window { messages, bytes }, length) = (self.queue.for_lines(), message.payload.len());
        // One may reach beyond the bounds of lines that it began in.
        let bytes_beyond = beyond.bytes.saturating_sub(payload_max);
        let left = left_beside(bytes_beyond, queue_bytes);
        // As in any queue, one waits alone however long it is. It may come into a line, and then the next one waits alone: so that ends, as far
        // beyond as the least of the room for each line leads, too.
        let waits_alone = bytes == 0 && bytes_beyond < queue_bytes.saturating_mul(3);
        let has_bytes = waits_alone || bytes + length <= room_of(left, queue_bytes, SHORT);
        let left = left_beside(beyond.messages, queue_capacity);
        has_bytes && messages < room_of(left, queue_capacity, 1)
    }

    /// Whether the queue holds no more than it may of what may come into a line, all classes together: what waited in lines comes back to it
    /// whatever its bounds.
    fn is_within_bounds(&self) -> bool {
        let OutletLimits { queue_capacity, queue_bytes, .. } = self.limits;
        let Window { messages, bytes } = self.queue.for_lines();
        messages <= CLASSES * queue_capacity && bytes <= CLASSES * queue_bytes
    }

    pub(super) fn put_in_line(&mut self, key: u64, message: Message) -> Result<(), Refused> {
        let has_room = self.is_within_bounds();
        let Some(session) = self.session.as_mut().filter(|_| has_room) else {
            self.counts.refused += 1;
            return Err(Refused::new(message, Rejection::QueueFull));
        };
        let (expiry, owed_by, bytes) = (message.header.expiry(), owed_by(&message), message.size());
        match session.held.put(key, message, bytes) {
            Ok(()) => {
                self.receipts.waits(owed_by);
                self.next_expiry = self.next_expiry.min(expiry);
                Ok(())
            }
            Err(message) => {
                self.counts.refused += 1;
                Err(Refused::new(message, Rejection::QueueFull))
            }
        }
    }

    /// The peer has said who is held: what waits changes between queue and lines, and keeps its order.
    pub(super) fn turn(&mut self, turn: Turn<Message>) {
        for message in turn.released.into_iter().rev() {
            // Never of class Stream, so it is not handed back.
            let _ = self.queue.put_back(message);
        }
        let Some(session) = self.session.as_mut().filter(|_| turn.holds_more) else { return };
        let waiting: Vec<_> = self.queue.drain_all().collect();
        for message in waiting {
            match line_of(&message.header).filter(|key| session.held.holds(*key)) {
                Some(key) => {
                    let bytes = message.size();
                    session.held.put_beyond(key, message, bytes);
                }
                // What was in the queue has room in it.
                None => self.queue.push_beyond(message),
            }
        }
    }

    /// Takes out of the lines what has expired; `next_expiry` takes what is left into account.
    pub(super) fn expire_lines(&mut self, now: Time, after: &mut After) {
        let Some(session) = &mut self.session else { return };
        let expired = session.held.take_expired(now);
        self.next_expiry = self.next_expiry.min(session.held.next_expiry());
        for message in expired {
            self.receipts.waits_no_more(owed_by(&message));
            self.expired(message, after);
        }
    }

    /// Takes the request that `ticket` names out of its line, if it waits in one.
    pub(super) fn take_request_in_line(&mut self, ticket: Ticket) -> Option<Message> {
        self.session.as_mut()?.held.take_useless(|message| message.is_request(ticket)).pop()
    }

    /// Takes all out of the lines.
    pub(super) fn empty_lines(&mut self) -> Vec<Message> {
        self.session.as_mut().map_or_else(Vec::new, |session| session.held.take_useless(|_| true))
    }
}
