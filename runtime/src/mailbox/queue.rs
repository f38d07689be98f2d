//! The pure queue of mailboxes and connections: one lane per class, each with its own bound.

#[cfg(test)]
mod tests;

use std::{collections::VecDeque, sync::Arc, task::Waker, time::Duration};

use super::{
    About, Budget,
    ends::{Ends, Place, Usage, is_end},
    room::Awaited,
};
use crate::{
    outcome::{Rejection, Ticket},
    router::SubmitError,
    time::Time,
    wire::{Class, Header, Message},
};

/// Number of messages of more urgent classes that pass a queued one before its turn. Otherwise endless urgent
/// traffic would stop the others forever.
const PASSED_OVER_MAX: u32 = 32;

/// The bounds of a queue, for each class separately.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Bounds {
    /// Maximum number of messages.
    pub messages: usize,
    /// Maximum total bytes of their payloads. One message of any length fits in an empty lane.
    pub bytes: usize,
}

impl Bounds {
    /// Returns whether `length` more bytes have room besides `held`.
    const fn has_bytes_for(self, length: usize, held: usize) -> bool {
        held == 0 || length <= self.bytes.saturating_sub(held)
    }

    /// Returns whether one more message of this `length` has room besides the `held` ones.
    const fn has_room_for(self, length: usize, held: Usage) -> bool {
        held.messages < self.messages && self.has_bytes_for(length, held.bytes)
    }
}

impl From<usize> for Bounds {
    /// A bound on the number alone, for a caller that limits the bytes itself.
    fn from(messages: usize) -> Self {
        Self { messages, bytes: usize::MAX }
    }
}

/// A queue of messages in the order of their handling: Control, then Stream, then Bulk.
///
/// - Control and Bulk keep the order of arrival.
/// - Stream keeps one message per source and kind: a newer one replaces the older, at its position.
/// - A lane that was passed over 32 times gets one turn.
/// - Remaining messages of a lost node, and the event about its end, precede all others. They occupy their
///   lane's positions until they are taken.
/// - A full lane rejects; it never drops. It is full at its maximum number of messages or of bytes.
#[derive(Debug)]
pub struct ClassQueue {
    pub(super) lanes: [VecDeque<Message>; 3],
    /// The remaining messages of lost nodes, each followed by the event about its end.
    pub(super) ends: Ends,
    /// The number of events about a node's end in the lanes.
    pub(super) ends_in_lanes: usize,
    /// Bytes of the payloads in each lane.
    pub(super) bytes: [usize; 3],
    passed_over: [u32; 3],
    bounds: Bounds,
    /// The budget that it shares with other queues.
    pub(super) budget: Option<Arc<Budget>>,
    /// No queued message expires before this.
    earliest_expiry: Time,
    /// The callers that wait for room, usually none.
    awaited: Option<Awaited>,
}

impl ClassQueue {
    /// Creates an empty queue with these bounds for each class.
    #[must_use]
    pub fn new(bounds: impl Into<Bounds>) -> Self {
        Self {
            lanes: [const { VecDeque::new() }; 3],
            ends: Ends::default(),
            ends_in_lanes: 0,
            bytes: [0; 3],
            passed_over: [0; 3],
            bounds: bounds.into(),
            budget: None,
            earliest_expiry: Time::MAX,
            awaited: None,
        }
    }

    /// Same as [`new`](Self::new), within a budget that it shares with other queues.
    #[must_use]
    pub fn sharing(bounds: impl Into<Bounds>, budget: Arc<Budget>) -> Self {
        let mut queue = Self::new(bounds);
        queue.budget = Some(budget);
        queue
    }

    /// Queues a message. Returns the older Stream message that it replaced, if any.
    ///
    /// # Errors
    /// The message itself, if the lane of its class is full. An older queued value then stays.
    pub fn push(&mut self, message: Message) -> Result<Option<Message>, SubmitError> {
        let (class, length) = (message.header.class, message.payload.len());
        let held = self.held(class as usize);
        if class == Class::Stream
            && let Some(older) = older_value(&mut self.lanes[class as usize], &message.header)
        {
            let former = older.payload.len();
            if !self.bounds.has_bytes_for(length, held.bytes - former)
                || !swap_budget(self.budget.as_deref(), length, former)
            {
                return Err(SubmitError::new(message, Rejection::QueueFull));
            }
            let in_lane = &mut self.bytes[class as usize];
            *in_lane = *in_lane - former + length;
            self.earliest_expiry = self.earliest_expiry.min(message.header.expiry());
            self.ends_in_lanes += usize::from(is_end(&message.header));
            self.ends_in_lanes -= usize::from(is_end(&older.header));
            return Ok(Some(std::mem::replace(older, message)));
        }
        if !self.bounds.has_room_for(length, held) || !swap_budget(self.budget.as_deref(), length, 0) {
            return Err(SubmitError::new(message, Rejection::QueueFull));
        }
        self.earliest_expiry = self.earliest_expiry.min(message.header.expiry());
        if About::of(&message.header).is_none() {
            // Nearly every message: it is not moved through the check for others that it must follow.
            self.append(message);
            return Ok(None);
        }
        if let Some(message) = self.place_behind(message, Place::Lane) {
            self.append(message);
        }
        Ok(None)
    }

    /// Queues a message behind all others of its class, beyond the bound, and replaces none. For the few
    /// messages that depend on the order; the caller must limit their number.
    pub fn push_beyond(&mut self, message: Message) {
        self.earliest_expiry = self.earliest_expiry.min(message.header.expiry());
        self.add(message.payload.len());
        self.append(message);
    }

    /// Adds a message to the end of the lane of its class.
    #[inline]
    fn append(&mut self, message: Message) {
        self.enters_lane(&message);
        self.lanes[message.header.class as usize].push_back(message);
    }

    /// Returns the messages that occupy positions of a lane: those queued in it, and those moved forward from it.
    pub(super) fn held(&self, class: usize) -> Usage {
        let at_ends = self.ends.of_lane(class);
        Usage {
            messages: self.lanes[class].len() + at_ends.messages,
            bytes: self.bytes[class] + at_ends.bytes,
        }
    }

    /// Registers a caller that keeps this message, which found no room. [`room_made`](Self::room_made) then
    /// returns its waker when there is room. Returns the wakers to be woken now: all if there is room already,
    /// or the oldest one of too many.
    #[must_use = "the tasks of these wakers would wait in vain"]
    pub fn offered(&mut self, message: &Message, room: &Waker) -> Vec<Waker> {
        let (class, length) = (message.header.class, message.payload.len());
        let oldest = self.awaited.get_or_insert_default().add(class, length, room);
        let mut woken = self.room_made();
        woken.extend(oldest);
        woken
    }

    /// Returns whether a caller waits for room.
    #[must_use]
    #[inline]
    pub const fn is_awaited(&self) -> bool {
        self.awaited.is_some()
    }

    /// Returns the registered wakers, once there is room: half of the positions of a class, and half of the
    /// bytes or as many as its shortest message needs. Call it after each removal of a message, and wake without
    /// a lock. It costs one load while none is registered.
    #[must_use = "the tasks of these wakers would wait in vain"]
    #[inline]
    pub fn room_made(&mut self) -> Vec<Waker> {
        if self.awaited.is_none() { Vec::new() } else { self.room_made_for_waiting() }
    }

    fn room_made_for_waiting(&mut self) -> Vec<Waker> {
        let has_room = self.awaited.as_ref().is_some_and(|awaited| {
            awaited.any(|class, length| {
                let held = self.held(class);
                held.messages <= self.bounds.messages / 2
                    && self.bounds.has_bytes_for(length.max(self.bounds.bytes / 2), held.bytes)
                    && self.budget.as_ref().is_none_or(|budget| budget.has_room_for(length))
            })
        });
        if has_room { self.awaited_no_more() } else { Vec::new() }
    }

    /// Returns the registered wakers, with or without room, because the callers must be notified of another change.
    #[must_use = "the tasks of these wakers would wait in vain"]
    pub fn awaited_no_more(&mut self) -> Vec<Waker> {
        self.awaited.take().map_or_else(Vec::new, Awaited::into_wakers)
    }

    /// Returns whether a newer value of this Stream message is queued.
    #[must_use]
    pub fn supersedes(&self, older: &Header) -> bool {
        let lane = &self.lanes[Class::Stream as usize];
        older.class == Class::Stream
            && (self.ends.has_value_of(older)
                || lane.iter().any(|newer| is_same_stream(&newer.header, older)))
    }

    /// Puts a popped message back before all others of its class, beyond the bound. Returns the message if it
    /// is of a Stream with a newer queued value.
    pub fn put_back(&mut self, message: Message) -> Option<Message> {
        if self.supersedes(&message.header) {
            return Some(message);
        }
        self.earliest_expiry = self.earliest_expiry.min(message.header.expiry());
        self.add(message.payload.len());
        if let Some(message) = self.put_back_before_end(message) {
            self.enters_lane(&message);
            self.lanes[message.header.class as usize].push_front(message);
        }
        None
    }

    /// Removes and returns the next message to handle.
    pub fn pop(&mut self) -> Option<Message> {
        if let Some(next) = self.ends.pop() {
            self.release(next.payload.len());
            return Some(next);
        }
        let first = self.lanes.iter().position(|lane| !lane.is_empty())?;
        let overdue = (first + 1..3)
            .find(|lane| self.passed_over[*lane] >= PASSED_OVER_MAX && !self.lanes[*lane].is_empty());
        let chosen = overdue.unwrap_or(first);
        self.passed_over[chosen] = 0;
        for lane in chosen + 1..3 {
            if !self.lanes[lane].is_empty() {
                self.passed_over[lane] += 1;
            }
        }
        // It is accounted for before it is taken, so that it is moved once: to the caller.
        let next = self.lanes[chosen].front()?;
        let (length, is_end) = (next.payload.len(), is_end(&next.header));
        self.bytes[chosen] -= length;
        self.ends_in_lanes -= usize::from(is_end);
        self.release(length);
        self.lanes[chosen].pop_front()
    }

    /// Removes and returns the next message of a class, if it belongs to one that was [popped](Self::pop).
    pub fn pop_if(&mut self, class: Class, is_it: impl FnOnce(&Message) -> bool) -> Option<Message> {
        let next = self.lanes[class as usize].pop_front_if(|message| is_it(message))?;
        self.left_lane(&next);
        Some(next)
    }

    /// Returns the last queued message of a class, to add something to it. Its class, times and length stay.
    pub fn last_mut(&mut self, class: Class) -> Option<&mut Message> {
        self.lanes[class as usize].back_mut()
    }

    /// Accounts for a message that enters the lane of its class.
    fn enters_lane(&mut self, message: &Message) {
        self.bytes[message.header.class as usize] += message.payload.len();
        self.ends_in_lanes += usize::from(is_end(&message.header));
    }

    /// Accounts for a message that left the lane of its class, and the queue.
    fn left_lane(&mut self, message: &Message) {
        self.bytes[message.header.class as usize] -= message.payload.len();
        self.ends_in_lanes -= usize::from(is_end(&message.header));
        self.release(message.payload.len());
    }

    /// Adds held bytes, beyond the bounds.
    pub(super) fn add(&self, bytes: usize) {
        if let Some(budget) = &self.budget {
            budget.add(bytes);
        }
    }

    /// Subtracts held bytes.
    pub(super) fn release(&self, bytes: usize) {
        if let Some(budget) = &self.budget {
            budget.release(bytes);
        }
    }

    /// Removes the messages that have expired by `now`. Costs nothing while none can have expired.
    pub fn take_expired(&mut self, now: Time) -> Vec<Message> {
        let mut expired = Vec::new();
        if now <= self.earliest_expiry {
            return expired;
        }
        self.earliest_expiry = self.ends.take_expired(now, &mut expired);
        for (lane, bytes) in self.lanes.iter_mut().zip(&mut self.bytes) {
            for message in std::mem::take(lane) {
                if message.header.is_expired(now) {
                    *bytes -= message.payload.len();
                    self.ends_in_lanes -= usize::from(is_end(&message.header));
                    expired.push(message);
                } else {
                    self.earliest_expiry = self.earliest_expiry.min(message.header.expiry());
                    lane.push_back(message);
                }
            }
        }
        self.release(expired.iter().map(|message| message.payload.len()).sum());
        expired
    }

    /// Returns the time before which no queued message expires.
    #[must_use]
    pub const fn next_expiry(&self) -> Time {
        self.earliest_expiry
    }

    /// Removes and returns the request of `ticket`, if it is queued.
    pub fn take_request(&mut self, ticket: Ticket) -> Option<Message> {
        if let Some(request) = self.ends.take_request(ticket) {
            self.release(request.payload.len());
            return Some(request);
        }
        // A request is usually cancelled soon after it was made, so the search starts at the end.
        let place = |lane: &VecDeque<Message>| lane.iter().rposition(|message| message.is_request(ticket));
        let (lane, at) = (0..3).find_map(|lane| Some((lane, place(&self.lanes[lane])?)))?;
        let request = self.lanes[lane].remove(at)?;
        self.left_lane(&request);
        Some(request)
    }

    /// Returns the queued messages, most urgent class first.
    pub fn iter(&self) -> impl Iterator<Item = &Message> {
        self.ends.iter().chain(self.lanes.iter().flatten())
    }

    /// Returns the greatest age of the messages that are first in their lanes: a lane keeps the order of arrival. An
    /// event of a layer has no age.
    pub(super) fn oldest(&self, now: Time) -> Option<Duration> {
        let first = self.lanes.iter().filter_map(VecDeque::front);
        let sent = first.filter(|message| About::of(&message.header).is_none());
        sent.filter_map(|message| message.header.age(now)).max()
    }

    /// Returns the number of queued messages.
    #[must_use]
    #[inline]
    pub fn len(&self) -> usize {
        self.ends.iter().len() + self.lanes.iter().map(VecDeque::len).sum::<usize>()
    }

    /// Returns the number of queued messages of `class`.
    #[must_use]
    pub fn len_of(&self, class: Class) -> usize {
        let at_ends = self.ends.iter().filter(|message| message.header.class == class).count();
        at_ends + self.lanes[class as usize].len()
    }

    /// Returns the bytes of the queued payloads.
    #[must_use]
    #[inline]
    pub fn bytes(&self) -> usize {
        self.ends.bytes() + self.bytes.iter().sum::<usize>()
    }

    /// Returns whether the queue is empty.
    #[must_use]
    #[inline]
    pub fn is_empty(&self) -> bool {
        self.ends.iter().len() == 0 && self.lanes.iter().all(VecDeque::is_empty)
    }

    /// Empties the queue, most urgent class first.
    pub fn drain_all(&mut self) -> impl Iterator<Item = Message> + use<> {
        self.release(self.bytes());
        (self.bytes, self.ends_in_lanes) = ([0; 3], 0);
        self.ends.take_all().chain(std::mem::take(&mut self.lanes).into_iter().flatten())
    }
}

impl Drop for ClassQueue {
    fn drop(&mut self) {
        self.release(self.bytes());
    }
}

/// Returns whether a budget has room for `length` bytes in place of `former` ones; if so, they are counted.
fn swap_budget(budget: Option<&Budget>, length: usize, former: usize) -> bool {
    let Some(budget) = budget else { return true };
    if let Some(fewer) = former.checked_sub(length) {
        budget.release(fewer);
        return true;
    }
    budget.take(length - former)
}

/// Returns the queued value that one with this header replaces. A value before a
/// [mark](ClassQueue::push_beyond) of the same source is never replaced, because messages sent before the
/// mark must stay before it.
fn older_value<'a>(lane: &'a mut VecDeque<Message>, header: &Header) -> Option<&'a mut Message> {
    let is_mark = |other: &Header| {
        !other.kind.is_user() && other.source == header.source && other.destination == header.destination
    };
    let mut newest_first = lane.iter_mut().rev();
    let found = newest_first.find(|other| is_same_stream(&other.header, header) || is_mark(&other.header))?;
    is_same_stream(&found.header, header).then_some(found)
}

/// Returns whether the newer of two Stream messages replaces the older.
#[must_use]
pub fn is_same_stream(one: &Header, other: &Header) -> bool {
    one.source == other.source && one.kind == other.kind && one.destination == other.destination
}
