//! The pure queue behind mailboxes and connections: one lane a class, each with its own bound.

#[cfg(test)]
mod tests;

use std::{collections::VecDeque, sync::Arc, task::Waker};

use super::{
    Budget,
    ends::{Ends, Held, Place, is_end},
    room::Awaited,
};
use crate::{
    outcome::{Rejection, Ticket},
    router::Refused,
    time::Time,
    wire::{Class, Header, Message},
};

/// So many messages of more urgent classes pass a waiting one before it has its turn: urgent traffic that never ends
/// must not stop the rest for ever.
const PASSED_OVER_MAX: u32 = 32;

/// What a queue holds at most, each class by itself.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub struct Bounds {
    /// Messages.
    pub messages: usize,
    /// Bytes of their payloads, all together. One message is held where nothing else is, however long it is.
    pub bytes: usize,
}

impl Bounds {
    /// Whether `length` bytes more have room beside `held`.
    const fn has_bytes_for(self, length: usize, held: usize) -> bool {
        held == 0 || length <= self.bytes.saturating_sub(held)
    }

    /// Whether one message more of this `length` has room beside what is `held`.
    const fn has_room_for(self, length: usize, held: Held) -> bool {
        held.messages < self.messages && self.has_bytes_for(length, held.bytes)
    }
}

impl From<usize> for Bounds {
    /// So many messages, however long: where who puts them in bounds their bytes.
    fn from(messages: usize) -> Self {
        Self { messages, bytes: usize::MAX }
    }
}

/// Messages in the order in which they are to be handled: Control, then Stream, then Bulk.
///
/// - Control and Bulk keep the order in which they came.
/// - Stream keeps one message for each source and kind: a newer one takes the place of the older, and its turn.
/// - A lane that was passed over 32 times has one turn.
/// - What is left of a node whose end is told, and that, goes before all else. It holds its lane's places until it is taken.
/// - A full lane refuses; it never drops. It is full when it holds as many messages, or as many bytes, as it may.
#[derive(Debug)]
pub struct ClassQueue {
    pub(super) lanes: [VecDeque<Message>; 3],
    /// What is left of nodes that are gone, each with what is said of that behind it.
    pub(super) ends: Ends,
    /// Of what waits in the lanes, how much is said of a node's end.
    pub(super) ends_in_lanes: usize,
    /// Bytes of the payloads in each lane.
    pub(super) bytes: [usize; 3],
    passed_over: [u32; 3],
    bounds: Bounds,
    /// What it shares with others.
    pub(super) budget: Option<Arc<Budget>>,
    /// Nothing that waits expires before this.
    earliest_expiry: Time,
    /// Who waits for room.
    awaited: Option<Awaited>,
}

impl ClassQueue {
    /// An empty queue that holds at most so much of each class.
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

    /// The same, within a budget that it shares with other queues.
    #[must_use]
    pub fn sharing(bounds: impl Into<Bounds>, budget: Arc<Budget>) -> Self {
        let mut queue = Self::new(bounds);
        queue.budget = Some(budget);
        queue
    }

    /// Takes a message. Returns the older Stream message that it replaced, if any.
    ///
    /// # Errors
    /// The message itself, if the lane of its class is full. An older value that waits stays there then.
    pub fn push(&mut self, message: Message) -> Result<Option<Message>, Refused> {
        let (class, length) = (message.header.class, message.payload.len());
        let held = self.held(class as usize);
        if class == Class::Stream
            && let Some(older) = older_value(&mut self.lanes[class as usize], &message.header)
        {
            let former = older.payload.len();
            if !self.bounds.has_bytes_for(length, held.bytes - former)
                || !takes_instead(self.budget.as_deref(), length, former)
            {
                return Err(Refused::new(message, Rejection::QueueFull));
            }
            let in_lane = &mut self.bytes[class as usize];
            *in_lane = *in_lane - former + length;
            self.earliest_expiry = self.earliest_expiry.min(message.header.expiry());
            self.ends_in_lanes += usize::from(is_end(&message.header));
            self.ends_in_lanes -= usize::from(is_end(&older.header));
            return Ok(Some(std::mem::replace(older, message)));
        }
        if !self.bounds.has_room_for(length, held) || !takes_instead(self.budget.as_deref(), length, 0) {
            return Err(Refused::new(message, Rejection::QueueFull));
        }
        self.earliest_expiry = self.earliest_expiry.min(message.header.expiry());
        if let Some(message) = self.place_behind(message, Place::Lane) {
            self.enters_lane(&message);
            self.lanes[class as usize].push_back(message);
        }
        Ok(None)
    }

    /// Takes a message behind all others of its class, whatever the bound, and replaces none. For the few whose place in the
    /// order counts; who uses it bounds how many there are.
    pub fn push_beyond(&mut self, message: Message) {
        self.earliest_expiry = self.earliest_expiry.min(message.header.expiry());
        self.add(message.payload.len());
        self.enters_lane(&message);
        self.lanes[message.header.class as usize].push_back(message);
    }

    /// Whether there is room for this message beside all that waits.
    #[must_use]
    pub fn has_room_for(&self, message: &Message) -> bool {
        self.bounds.has_room_for(message.payload.len(), self.held(message.header.class as usize))
    }

    /// What holds places of a lane: what waits in it, and what was brought forward from it.
    pub(super) fn held(&self, class: usize) -> Held {
        let at_ends = self.ends.of_lane(class);
        Held {
            messages: self.lanes[class].len() + at_ends.messages,
            bytes: self.bytes[class] + at_ends.bytes,
        }
    }

    /// Somebody keeps this message, which found no room, and waits for some: [`room_made`](Self::room_made) says when. Returns the waker if
    /// there is room by now. One waits at most; another one takes its place.
    pub fn offered(&mut self, message: &Message, room: &Waker) -> Option<Waker> {
        let (class, length) = (message.header.class, message.payload.len());
        self.awaited = Some(Awaited::with(self.awaited.take(), class, length, room));
        self.room_made()
    }

    /// Whoever waits for room, once there is: half of the places of its class, and of the bytes half or what it needs. To be asked
    /// whenever a message was taken out; to be woken without a lock.
    pub fn room_made(&mut self) -> Option<Waker> {
        let awaited = self.awaited.as_ref()?;
        let has_room = awaited.any(|class, length| {
            let held = self.held(class);
            held.messages <= self.bounds.messages / 2
                && self.bounds.has_bytes_for(length.max(self.bounds.bytes / 2), held.bytes)
                && self.budget.as_ref().is_none_or(|budget| budget.has_room_for(length))
        });
        if has_room { self.awaited_no_more() } else { None }
    }

    /// Whoever waits for room, whether there is or not: it is told something else.
    pub fn awaited_no_more(&mut self) -> Option<Waker> {
        self.awaited.take().map(Awaited::into_waker)
    }

    /// Whether a newer value of this Stream message waits.
    #[must_use]
    pub fn supersedes(&self, older: &Header) -> bool {
        let lane = &self.lanes[Class::Stream as usize];
        older.class == Class::Stream
            && (self.ends.has_value_of(older)
                || lane.iter().any(|newer| is_same_stream(&newer.header, older)))
    }

    /// Puts a message back that was popped, before all others of its class, whatever the bound. Hands it back if it is
    /// of a Stream whose newer value waits here.
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

    /// The next message to handle.
    pub fn pop(&mut self) -> Option<Message> {
        if let Some(next) = self.ends.pop() {
            self.give(next.payload.len());
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
        let next = self.lanes[chosen].pop_front()?;
        self.left_lane(&next);
        Some(next)
    }

    /// The next message of a class, if it is of the sort that goes with one that was [popped](Self::pop).
    pub fn pop_if(&mut self, class: Class, is_it: impl FnOnce(&Message) -> bool) -> Option<Message> {
        let next = self.lanes[class as usize].pop_front_if(|message| is_it(message))?;
        self.left_lane(&next);
        Some(next)
    }

    /// A message comes to wait in the lane of its class.
    fn enters_lane(&mut self, message: &Message) {
        self.bytes[message.header.class as usize] += message.payload.len();
        self.ends_in_lanes += usize::from(is_end(&message.header));
    }

    /// A message was taken out of the lane of its class, and of the queue.
    fn left_lane(&mut self, message: &Message) {
        self.bytes[message.header.class as usize] -= message.payload.len();
        self.ends_in_lanes -= usize::from(is_end(&message.header));
        self.give(message.payload.len());
    }

    /// So many bytes are held more, whatever the bounds.
    pub(super) fn add(&self, bytes: usize) {
        if let Some(budget) = &self.budget {
            budget.add(bytes);
        }
    }

    /// So many bytes are held no more.
    pub(super) fn give(&self, bytes: usize) {
        if let Some(budget) = &self.budget {
            budget.give(bytes);
        }
    }

    /// Takes out what has expired by `now`. Costs nothing as long as nothing can have.
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
        self.give(expired.iter().map(|message| message.payload.len()).sum());
        expired
    }

    /// Nothing that waits expires before this.
    #[must_use]
    pub const fn next_expiry(&self) -> Time {
        self.earliest_expiry
    }

    /// Takes the request that `ticket` names out, if it waits.
    pub fn take_request(&mut self, ticket: Ticket) -> Option<Message> {
        if let Some(request) = self.ends.take_request(ticket) {
            self.give(request.payload.len());
            return Some(request);
        }
        // Who gives a request up has mostly just made it.
        let place = |lane: &VecDeque<Message>| lane.iter().rposition(|message| message.is_request(ticket));
        let (lane, at) = (0..3).find_map(|lane| Some((lane, place(&self.lanes[lane])?)))?;
        let request = self.lanes[lane].remove(at)?;
        self.left_lane(&request);
        Some(request)
    }

    /// All that waits, most urgent class first.
    pub fn iter(&self) -> impl Iterator<Item = &Message> {
        self.ends.iter().chain(self.lanes.iter().flatten())
    }

    /// Messages that wait.
    #[must_use]
    pub fn len(&self) -> usize {
        self.ends.iter().len() + self.lanes.iter().map(VecDeque::len).sum::<usize>()
    }

    /// Messages of `class` that wait.
    #[must_use]
    pub fn len_of(&self, class: Class) -> usize {
        let at_ends = self.ends.iter().filter(|message| message.header.class == class).count();
        at_ends + self.lanes[class as usize].len()
    }

    /// Bytes of the payloads that wait.
    #[must_use]
    pub fn bytes(&self) -> usize {
        self.ends.bytes() + self.bytes.iter().sum::<usize>()
    }

    /// Whether none waits.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.ends.iter().len() == 0 && self.lanes.iter().all(VecDeque::is_empty)
    }

    /// Empties the queue, most urgent class first.
    pub fn drain_all(&mut self) -> impl Iterator<Item = Message> + use<> {
        self.give(self.bytes());
        (self.bytes, self.ends_in_lanes) = ([0; 3], 0);
        self.ends.take_all().chain(std::mem::take(&mut self.lanes).into_iter().flatten())
    }
}

impl Drop for ClassQueue {
    fn drop(&mut self) {
        self.give(self.bytes());
    }
}

/// Whether a budget has room for `length` bytes in the place of `former` ones; if so, they are counted.
fn takes_instead(budget: Option<&Budget>, length: usize, former: usize) -> bool {
    let Some(budget) = budget else { return true };
    if let Some(fewer) = former.checked_sub(length) {
        budget.give(fewer);
        return true;
    }
    budget.take(length - former)
}

/// The value whose place one with this header takes: none that waits before a [mark](ClassQueue::push_beyond) of the same
/// source, for the mark says that what was sent before it comes before it.
fn older_value<'a>(lane: &'a mut VecDeque<Message>, header: &Header) -> Option<&'a mut Message> {
    let is_mark = |other: &Header| {
        !other.kind.is_user() && other.source == header.source && other.destination == header.destination
    };
    let mut newest_first = lane.iter_mut().rev();
    let found = newest_first.find(|other| is_same_stream(&other.header, header) || is_mark(&other.header))?;
    is_same_stream(&found.header, header).then_some(found)
}

/// Whether the newer of the two takes the place of the older, both being of class Stream.
#[must_use]
pub fn is_same_stream(one: &Header, other: &Header) -> bool {
    one.source == other.source && one.kind == other.kind && one.destination == other.destination
}
