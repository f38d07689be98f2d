//! The pure queue behind mailboxes and connections: one lane a class, each with its own bound.

use std::collections::VecDeque;

use crate::{
    outcome::Rejection,
    router::Refused,
    time::Time,
    wire::{Class, Header, Message},
};

/// So many messages of more urgent classes pass a waiting one before it has its turn: urgent traffic that never ends
/// must not stop the rest for ever.
const PASSED_OVER_MAX: u32 = 32;

/// Messages in the order in which they are to be handled: Control, then Stream, then Bulk.
///
/// - Control and Bulk keep the order in which they came.
/// - Stream keeps one message for each source and kind: a newer one takes the place of the older, and its turn.
/// - A lane that was passed over 32 times has one turn.
/// - A full lane refuses; it never drops.
#[derive(Debug)]
pub struct ClassQueue {
    lanes: [VecDeque<Message>; 3],
    passed_over: [u32; 3],
    capacity: usize,
    /// Nothing that waits expires before this.
    earliest_expiry: Time,
}

impl ClassQueue {
    /// An empty queue that holds at most `capacity` messages of each class.
    #[must_use]
    pub fn new(capacity: usize) -> Self {
        Self {
            lanes: [const { VecDeque::new() }; 3],
            passed_over: [0; 3],
            capacity,
            earliest_expiry: Time::MAX,
        }
    }

    /// Takes a message. Returns the older Stream message that it replaced, if any.
    ///
    /// # Errors
    /// The message itself, if the lane of its class is full.
    pub fn push(&mut self, message: Message) -> Result<Option<Message>, Refused> {
        let lane = &mut self.lanes[message.header.class as usize];
        if message.header.class == Class::Stream
            && let Some(older) = older_value(lane, &message.header)
        {
            self.earliest_expiry = self.earliest_expiry.min(message.header.expiry());
            return Ok(Some(std::mem::replace(older, message)));
        }
        if lane.len() >= self.capacity {
            return Err(Refused::new(message, Rejection::QueueFull));
        }
        self.earliest_expiry = self.earliest_expiry.min(message.header.expiry());
        lane.push_back(message);
        Ok(None)
    }

    /// Takes a message behind all others of its class, whatever the bound, and replaces none. For the few whose place in the
    /// order counts; who uses it bounds how many there are.
    pub fn push_beyond(&mut self, message: Message) {
        self.earliest_expiry = self.earliest_expiry.min(message.header.expiry());
        self.lanes[message.header.class as usize].push_back(message);
    }

    /// Whether [`push`](Self::push) would take a message with this header.
    #[must_use]
    pub fn has_room_for(&self, header: &Header) -> bool {
        let lane = &self.lanes[header.class as usize];
        lane.len() < self.capacity
            || header.class == Class::Stream && lane.iter().any(|other| is_same_stream(&other.header, header))
    }

    /// Whether a newer value of this Stream message waits.
    #[must_use]
    pub fn supersedes(&self, older: &Header) -> bool {
        let lane = &self.lanes[Class::Stream as usize];
        older.class == Class::Stream && lane.iter().any(|newer| is_same_stream(&newer.header, older))
    }

    /// Puts a message back that was popped, before all others of its class, whatever the bound. Hands it back if it is
    /// of a Stream whose newer value waits here.
    pub fn put_back(&mut self, message: Message) -> Option<Message> {
        let lane = &mut self.lanes[message.header.class as usize];
        let header = &message.header;
        if header.class == Class::Stream && lane.iter().any(|newer| is_same_stream(&newer.header, header)) {
            return Some(message);
        }
        self.earliest_expiry = self.earliest_expiry.min(message.header.expiry());
        lane.push_front(message);
        None
    }

    /// The next message to handle.
    pub fn pop(&mut self) -> Option<Message> {
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
        self.lanes[chosen].pop_front()
    }

    /// Takes out what has expired by `now`. Costs nothing as long as nothing can have.
    pub fn take_expired(&mut self, now: Time) -> Vec<Message> {
        let mut expired = Vec::new();
        if now <= self.earliest_expiry {
            return expired;
        }
        self.earliest_expiry = Time::MAX;
        for lane in &mut self.lanes {
            for message in std::mem::take(lane) {
                if message.header.is_expired(now) {
                    expired.push(message);
                } else {
                    self.earliest_expiry = self.earliest_expiry.min(message.header.expiry());
                    lane.push_back(message);
                }
            }
        }
        expired
    }

    /// Messages that wait.
    #[must_use]
    pub fn len(&self) -> usize {
        self.lanes.iter().map(VecDeque::len).sum()
    }

    /// Whether none waits.
    #[must_use]
    pub fn is_empty(&self) -> bool {
        self.lanes.iter().all(VecDeque::is_empty)
    }

    /// Empties the queue, most urgent class first.
    pub fn drain_all(&mut self) -> impl Iterator<Item = Message> + '_ {
        self.lanes.iter_mut().flat_map(|lane| lane.drain(..))
    }
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

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use proptest::prelude::*;

    use super::*;
    use crate::{
        tid::{AppAddress, NodeAddress, Tid},
        wire::{Header, Kind},
    };

    fn message(class: Class, source: u32, sequence: u64) -> Message {
        let source = Tid::new(NodeAddress::new(1), AppAddress::new(source));
        let mut header = Header::new(Kind::named("test"), source, Tid::NONE);
        (header.class, header.sequence) = (class, sequence);
        Message::new(header, Bytes::new())
    }

    #[test]
    fn control_passes_everything_and_bulk_yields() {
        let mut queue = ClassQueue::new(4);
        for (class, number) in [(Class::Bulk, 1), (Class::Stream, 2), (Class::Control, 3)] {
            queue.push(message(class, 9, number)).unwrap();
        }
        let order: Vec<_> = std::iter::from_fn(|| queue.pop()).map(|m| m.header.sequence).collect();
        assert_eq!(order, [3, 2, 1]);
    }

    #[test]
    fn newest_value_of_a_stream_takes_the_olders_turn() {
        let mut queue = ClassQueue::new(4);
        queue.push(message(Class::Stream, 7, 1)).unwrap();
        queue.push(message(Class::Stream, 8, 2)).unwrap();
        let superseded = queue.push(message(Class::Stream, 7, 3)).unwrap();
        assert_eq!(superseded.map(|m| m.header.sequence), Some(1));
        let order: Vec<_> = std::iter::from_fn(|| queue.pop()).map(|m| m.header.sequence).collect();
        assert_eq!(order, [3, 2]);
    }

    #[test]
    fn endless_control_traffic_does_not_stop_bulk_for_ever() {
        let mut queue = ClassQueue::new(64);
        queue.push(message(Class::Bulk, 1, 999)).unwrap();
        let mut pops = 0;
        loop {
            queue.push(message(Class::Control, 1, pops)).unwrap();
            if queue.pop().unwrap().header.class == Class::Bulk {
                break;
            }
            pops += 1;
            assert!(pops <= u64::from(PASSED_OVER_MAX));
        }
        assert_eq!(pops, u64::from(PASSED_OVER_MAX));
    }

    proptest! {
        #[test]
        fn nothing_is_lost_or_reordered_within_a_class(
            inputs in proptest::collection::vec((0usize..3, 0u32..4, any::<bool>()), 0..200),
        ) {
            let mut queue = ClassQueue::new(8);
            let (mut taken, mut left, mut last) = (0, 0, [0u64; 3]);
            for (number, (class, source, pop)) in (1u64..).zip(inputs) {
                match queue.push(message(Class::ALL[class], source, number)) {
                    Ok(None) => taken += 1,
                    Ok(Some(older)) => prop_assert!(older.header.class == Class::Stream),
                    Err(refused) => prop_assert_eq!(refused.why, Rejection::QueueFull),
                }
                if pop && let Some(next) = queue.pop() {
                    left += 1;
                    let class = next.header.class;
                    if class != Class::Stream {
                        prop_assert!(next.header.sequence > last[class as usize]);
                    }
                    last[class as usize] = next.header.sequence;
                }
                prop_assert!(queue.lanes.iter().all(|lane| lane.len() <= 8));
            }
            prop_assert_eq!(taken, left + queue.len());
        }
    }
}
