//! Messages that have not been sent yet: in the queue, or in the backlog of a destination that accepts
//! nothing now. Messages for other destinations pass the latter. spec: CREDIT-3
//!
//! An accepted message is never dropped for lack of room. When its destination becomes held, a queued message
//! moves to the backlog, without regard to its bounds. Destinations that are held one after the other could
//! each move a whole queue there. To prevent that, the queue accepts less the more the backlog exceeds its
//! bounds. spec: CREDIT-4

use std::{sync::Arc, task::Waker};

use sinew_runtime::{
    WakerList,
    mailbox::{Bounds, Budget, ClassQueue},
    outcome::{Rejection, Ticket},
    router::SubmitError,
    tid::AppAddress,
    time::Time,
    wire::{Class, Flags, Header, Kind, Message},
};

use super::{OutletLimits, batch::SHORT, queue::SendQueue};
use crate::{Ack, BacklogLimits, HeldChange, SendBacklog, Window};

/// Bounds of the sender's backlog: as many destinations as a receiver holds. The bound in messages is that of
/// the session's window, and a quarter of it for each destination.
const BACKLOG_LIMITS: BacklogLimits =
    BacklogLimits { queues: 256, queue_messages: 0, queue_bytes: 1 << 20, messages: 0, bytes: 4 << 20 };

/// The number of classes. Each class has the queue's bounds for itself.
const CLASSES: usize = 3;

/// Whether the queue's bounds apply to a message.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Bound {
    Kept,
    /// The submitter bounds the number of these messages.
    Waived,
}

/// Returns the part of twice the queue's `bound` that remains when the backlog is `excess` over its bounds.
const fn room_beside(excess: usize, bound: usize) -> usize {
    bound.saturating_mul(2).saturating_sub(excess)
}

/// Returns how much of `left` the queue may hold: half, so that each further destination adds less. At
/// `least` this amount remains for destinations that accept messages.
fn room_of(left: usize, bound: usize, least: usize) -> usize {
    (left / 2).max(bound / BACKLOG_LIMITS.queues).max(least)
}

/// Returns the key of a destination that may be held, by class: an application's mailbox. Stream has none,
/// because only its newest value is queued.
#[inline]
pub fn backlog_key(header: &Header) -> Option<u64> {
    let is_for_a_mailbox = header.destination.is_single()
        && !header.destination.app.is_layer()
        // An application that waits for an answer may accept nothing else before it.
        && !header.flags.has(Flags::OUTCOME)
        && !header.flags.has(Flags::REPLY)
        // A cancel message revokes a request that may wait in the backlog.
        && header.kind != Kind::CANCEL;
    match header.class {
        Class::Control | Class::Bulk if is_for_a_mailbox => {
            Some((header.class as u64) << 32 | u64::from(header.destination.app.bits()))
        }
        Class::Control | Class::Bulk | Class::Stream => None,
    }
}

/// Returns the application that a backlog key is for.
pub const fn destination_of(key: u64) -> AppAddress {
    // The address is the lower half of the key.
    AppAddress::new(key as u32)
}

/// The senders of messages that find no room because of the backlog.
#[derive(Default)]
struct BacklogWaits {
    wakers: WakerList,
    /// The number of messages in the queue when the last one was registered.
    queued: usize,
}

/// The messages of an outlet that have not been sent yet.
pub(super) struct Unsent {
    limits: OutletLimits,
    pub(super) queue: SendQueue,
    /// The frame that was being written when the last connection ended. No peer can have handled it, so it is
    /// sent first.
    interrupted: Option<Message>,
    /// Messages for destinations that accept nothing now. `None` without a session.
    backlog: Option<SendBacklog<u64, Message>>,
    /// A lower bound of the messages' expiry.
    next_expiry: Time,
    backlog_waits: BacklogWaits,
}

impl Unsent {
    /// Returns an empty state. `budget` counts the queued messages, too. `window` is that of the session, if
    /// there is one.
    pub(super) fn new(limits: OutletLimits, budget: Option<Arc<Budget>>, window: Option<Window>) -> Self {
        let bounds = Bounds { messages: limits.queue_capacity, bytes: limits.queue_bytes };
        let queue = match budget {
            Some(budget) => ClassQueue::sharing(bounds, budget),
            None => ClassQueue::new(bounds),
        };
        let backlog = window.map(|Window { messages, .. }| {
            let queue_messages = messages.div_ceil(4);
            SendBacklog::new(BacklogLimits { queue_messages, messages, ..BACKLOG_LIMITS })
        });
        Self {
            limits,
            queue: SendQueue::new(queue),
            interrupted: None,
            backlog,
            next_expiry: Time::MAX,
            backlog_waits: BacklogWaits::default(),
        }
    }

    /// Whether there is nothing to send now.
    #[inline]
    pub(super) fn is_empty(&self) -> bool {
        self.queue.is_empty() && self.interrupted.is_none()
    }

    /// Returns the number of messages that can be sent now.
    #[inline]
    pub(super) fn ready(&self) -> usize {
        self.queue.len() + usize::from(self.interrupted.is_some())
    }

    /// Returns the number of messages in the backlog.
    #[inline]
    pub(super) fn in_backlog(&self) -> usize {
        self.backlog.as_ref().map_or(0, SendBacklog::messages)
    }

    /// Returns the number of all messages.
    pub(super) fn len(&self) -> usize {
        self.ready() + self.in_backlog()
    }

    /// Returns the messages that can be sent now.
    pub(super) fn iter(&self) -> impl Iterator<Item = &Message> {
        self.interrupted.iter().chain(self.queue.iter())
    }

    /// Returns a lower bound of the messages' expiry.
    #[inline]
    pub(super) const fn next_expiry(&self) -> Time {
        self.next_expiry
    }

    /// Queues a message. Returns whether it supersedes an older one.
    pub(super) fn enqueue(&mut self, message: Message, bound: Bound) -> Result<bool, SubmitError> {
        let expiry = message.header.expiry();
        let supersedes = match bound {
            Bound::Waived => {
                self.queue.push_beyond(message);
                false
            }
            Bound::Kept if !self.has_room_beside_backlog(&message) => {
                return Err(SubmitError::new(message, Rejection::QueueFull));
            }
            Bound::Kept => self.queue.push(message)?.is_some(),
        };
        self.next_expiry = self.next_expiry.min(expiry);
        Ok(supersedes)
    }

    /// Registers a sender that keeps this message, which found no room. [`room_made`](Self::room_made) then returns
    /// its waker. Returns the wakers to be woken now.
    pub(super) fn offered(&mut self, message: &Message, room: &Waker) -> Vec<Waker> {
        if self.held_key(&message.header).is_none() && self.has_room_beside_backlog(message) {
            return self.queue.offered(message, room);
        }
        // The queue may have room: its own waits would end at once, again and again.
        self.backlog_waits.queued = self.queue.len();
        self.backlog_waits.wakers.add(room).into_iter().collect()
    }

    /// Whether a sender waits for room.
    #[inline]
    pub(super) fn is_awaited(&self) -> bool {
        self.queue.is_awaited() || !self.backlog_waits.wakers.is_empty()
    }

    /// Returns the wakers of senders that may find room now that a message has left the queue. Call it after each
    /// one, if a sender waits.
    pub(super) fn room_made(&mut self) -> Vec<Waker> {
        let mut woken = self.queue.room_made();
        if !self.backlog_waits.wakers.is_empty() && self.queue.len() <= self.backlog_waits.queued / 2 {
            woken.extend(self.backlog_waits.wakers.take());
        }
        woken
    }

    /// Same as [`room_made`](Self::room_made), after messages were removed from the backlog or held destinations have
    /// changed.
    pub(super) fn backlog_changed(&mut self) -> Vec<Waker> {
        let mut woken = self.queue.room_made();
        woken.extend(self.backlog_waits.wakers.take());
        woken
    }

    /// Returns the wakers of all senders that wait for room: they must be notified of another change.
    pub(super) fn awaited_no_more(&mut self) -> Vec<Waker> {
        let mut woken = self.queue.awaited_no_more();
        woken.extend(self.backlog_waits.wakers.take());
        woken
    }

    /// Returns the next message to send.
    #[inline]
    pub(super) fn pop(&mut self) -> Option<Message> {
        self.interrupted.take().or_else(|| self.queue.pop())
    }

    /// Returns the backlog key of this message, if its destination is held.
    #[inline]
    pub(super) fn held_key(&self, header: &Header) -> Option<u64> {
        let backlog = self.backlog.as_ref().filter(|backlog| backlog.holds_any())?;
        backlog_key(header).filter(|key| backlog.holds(*key))
    }

    /// Whether the backlog leaves room in the queue for this message, which may move there later. spec:
    /// CREDIT-4
    #[inline]
    fn has_room_beside_backlog(&self, message: &Message) -> bool {
        let excess = self.backlog.as_ref().and_then(SendBacklog::excess);
        let Some(excess) = excess.filter(|_| backlog_key(&message.header).is_some()) else { return true };
        let OutletLimits { queue_capacity, queue_bytes, payload_max, .. } = self.limits;
        let (Window { messages, bytes }, length) = (self.queue.holdable(), message.payload.len());
        // One message may exceed the bounds of the backlog that it began in.
        let excess_bytes = excess.bytes.saturating_sub(payload_max);
        let left = room_beside(excess_bytes, queue_bytes);
        // As in any queue, a single message of any length may wait alone. It may move to the backlog, and the
        // next one then waits alone. This ends at the same amount to which the minimum room per destination
        // leads.
        let waits_alone = bytes == 0 && excess_bytes < queue_bytes.saturating_mul(3);
        let has_bytes = waits_alone || bytes + length <= room_of(left, queue_bytes, SHORT);
        let left = room_beside(excess.messages, queue_capacity);
        has_bytes && messages < room_of(left, queue_capacity, 1)
    }

    /// Whether the queue is within its bounds for messages that may move to the backlog, all classes
    /// together. Messages return from there without regard to its bounds.
    fn is_within_bounds(&self) -> bool {
        let OutletLimits { queue_capacity, queue_bytes, .. } = self.limits;
        let Window { messages, bytes } = self.queue.holdable();
        messages <= CLASSES * queue_capacity && bytes <= CLASSES * queue_bytes
    }

    /// Puts a message for a held destination into the backlog.
    pub(super) fn hold(&mut self, key: u64, message: Message) -> Result<(), SubmitError> {
        let has_room = self.is_within_bounds();
        let Some(backlog) = self.backlog.as_mut().filter(|_| has_room) else {
            return Err(SubmitError::new(message, Rejection::QueueFull));
        };
        let (expiry, bytes) = (message.header.expiry(), message.size());
        backlog
            .put(key, message, bytes)
            .map_err(|message| SubmitError::new(message, Rejection::QueueFull))?;
        self.next_expiry = self.next_expiry.min(expiry);
        Ok(())
    }

    /// Applies the peer's announcement of held destinations. Messages move between the queue and the backlog,
    /// and keep their order. Returns the wakers of senders that may find room now.
    pub(super) fn on_held(&mut self, ack: &Ack) -> Vec<Waker> {
        let former = self.backlog.as_ref().and_then(SendBacklog::change);
        self.apply_held(ack);
        let is_new = self.backlog.as_ref().and_then(SendBacklog::change) != former;
        if is_new { self.backlog_changed() } else { Vec::new() }
    }

    fn apply_held(&mut self, ack: &Ack) {
        let Some(backlog) = &mut self.backlog else { return };
        let HeldChange { holds_more, released } = backlog.on_held(ack.change, ack.held.iter().copied());
        for message in released.into_iter().rev() {
            // The class is never Stream, so the message is not returned.
            let _ = self.queue.put_back(message);
        }
        if !holds_more {
            return;
        }
        let waiting: Vec<_> = self.queue.drain_all().collect();
        for message in waiting {
            match backlog_key(&message.header).filter(|key| backlog.holds(*key)) {
                Some(key) => {
                    let bytes = message.size();
                    backlog.put_unbounded(key, message, bytes);
                }
                // The queue has room for messages that it held before.
                None => self.queue.push_beyond(message),
            }
        }
    }

    /// Processes the end of the connection.
    pub(super) const fn link_ended(&mut self) {
        if let Some(backlog) = &mut self.backlog {
            backlog.link_ended();
        }
    }

    /// Keeps the message that was being written for the next connection. Returns whether a newer queued value
    /// replaces it.
    pub(super) fn interrupt(&mut self, message: Message) -> bool {
        self.next_expiry = self.next_expiry.min(message.header.expiry());
        if message.header.class == Class::Stream {
            // No queued message is dropped to make room for it.
            return self.queue.put_back(message).is_some();
        }
        self.interrupted = Some(message);
        false
    }

    /// Removes the request that `ticket` names.
    pub(super) fn take_request(&mut self, ticket: Ticket) -> Option<Message> {
        let interrupted = self.interrupted.take_if(|message| message.is_request(ticket));
        interrupted
            .or_else(|| self.queue.take_request(ticket))
            .or_else(|| self.backlog.as_mut()?.take_useless(|message| message.is_request(ticket)).pop())
    }

    /// Removes the messages that have expired by `now`.
    pub(super) fn take_expired(&mut self, now: Time) -> Vec<Message> {
        let mut expired = Vec::new();
        if now <= self.next_expiry {
            return expired;
        }
        self.next_expiry = Time::MAX;
        if let Some(backlog) = &mut self.backlog {
            expired = backlog.take_expired(now);
            self.next_expiry = backlog.next_expiry();
        }
        expired.extend(self.interrupted.take_if(|message| message.header.is_expired(now)));
        if let Some(message) = &self.interrupted {
            self.next_expiry = self.next_expiry.min(message.header.expiry());
        }
        expired.extend(self.queue.take_expired(now));
        self.next_expiry = self.next_expiry.min(self.queue.next_expiry());
        expired
    }

    /// Removes all messages.
    pub(super) fn take_all(&mut self) -> Vec<Message> {
        let mut all: Vec<_> = self.interrupted.take().into_iter().chain(self.queue.drain_all()).collect();
        all.extend(self.backlog.as_mut().map_or_else(Vec::new, |backlog| backlog.take_useless(|_| true)));
        self.next_expiry = Time::MAX;
        all
    }
}
