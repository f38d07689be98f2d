//! The remaining messages of lost nodes in a queue: each node's messages, followed by the event about its end.

#[cfg(test)]
mod tests;

use std::collections::VecDeque;

use super::{About, ClassQueue, is_event, queue::is_same_stream};
use crate::{
    outcome::Ticket,
    tid::NodeAddress,
    time::Time,
    wire::{Class, Header, Message},
};

/// A number of messages, and the bytes of their payloads.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Usage {
    pub(super) messages: usize,
    pub(super) bytes: usize,
}

impl Usage {
    const fn count(&mut self, message: &Message) {
        self.messages += 1;
        self.bytes += message.payload.len();
    }

    const fn count_out(&mut self, message: &Message) {
        self.messages -= 1;
        self.bytes -= message.payload.len();
    }
}

/// The queue position that a message occupies until it is taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Place {
    /// A position in the lane of its class.
    Lane,
    /// A position beside the lanes: an event that is [kept behind](ClassQueue::queue_behind) messages.
    Behind,
}

/// Messages that precede all others, in their order. Each still occupies its former position: moving messages
/// here makes no room for more.
#[derive(Debug, Default)]
pub(super) struct Ends {
    messages: VecDeque<(Place, Message)>,
    /// For each class, the messages that occupy positions of its lane.
    of_lanes: [Usage; 3],
    behind: Usage,
}

impl Ends {
    fn push(&mut self, place: Place, message: Message) {
        self.usage_in(place, &message).count(&message);
        self.messages.push_back((place, message));
    }

    fn push_first(&mut self, message: Message) {
        self.usage_in(Place::Lane, &message).count(&message);
        self.messages.push_front((Place::Lane, message));
    }

    pub(super) fn pop(&mut self) -> Option<Message> {
        let (place, next) = self.messages.pop_front()?;
        self.usage_in(place, &next).count_out(&next);
        Some(next)
    }

    const fn usage_in(&mut self, place: Place, message: &Message) -> &mut Usage {
        match place {
            Place::Lane => &mut self.of_lanes[message.header.class as usize],
            Place::Behind => &mut self.behind,
        }
    }

    #[inline]
    pub(super) fn iter(&self) -> impl ExactSizeIterator<Item = &Message> {
        self.messages.iter().map(|(_, message)| message)
    }

    /// Returns the messages that occupy positions of the lane of this class.
    pub(super) const fn of_lane(&self, class: usize) -> Usage {
        self.of_lanes[class]
    }

    #[inline]
    pub(super) fn bytes(&self) -> usize {
        self.behind.bytes + self.of_lanes.iter().map(|held| held.bytes).sum::<usize>()
    }

    pub(super) fn take_all(&mut self) -> impl Iterator<Item = Message> + use<> {
        std::mem::take(self).messages.into_iter().map(|(_, message)| message)
    }

    /// Removes the messages that match `is_it`.
    fn remove_if(&mut self, is_it: impl Fn(&Message) -> bool) -> Vec<Message> {
        let mut taken = Vec::new();
        for (place, message) in std::mem::take(self).messages {
            if is_it(&message) {
                taken.push(message);
            } else {
                self.push(place, message);
            }
        }
        taken
    }

    /// Removes the messages that have expired by `now`. Returns when the next of the others expires.
    pub(super) fn take_expired(&mut self, now: Time, expired: &mut Vec<Message>) -> Time {
        expired.extend(self.remove_if(|message| message.header.is_expired(now)));
        self.iter().map(|message| message.header.expiry()).min().unwrap_or(Time::MAX)
    }

    pub(super) fn take_request(&mut self, ticket: Ticket) -> Option<Message> {
        let at = self.messages.iter().rposition(|(_, message)| message.is_request(ticket))?;
        let (place, request) = self.messages.remove(at)?;
        self.usage_in(place, &request).count_out(&request);
        Some(request)
    }

    /// Returns whether this has a message from this node or an event about it.
    fn has_any_of(&self, node: NodeAddress) -> bool {
        self.iter().any(|message| is_of(node, &message.header))
    }

    /// Returns whether this has a value of this stream. A new value does not replace it: an end is between them.
    pub(super) fn has_value_of(&self, stream: &Header) -> bool {
        let is_one = |header: &Header| header.class == Class::Stream && is_same_stream(header, stream);
        self.iter().any(|message| is_one(&message.header))
    }
}

/// Returns the node that sent the message, or that the event is about.
fn node_of(header: &Header) -> NodeAddress {
    About::of(header).map_or(header.source.node, About::node)
}

/// Returns whether the event is about the end of a node.
pub(super) fn is_end(header: &Header) -> bool {
    matches!(About::of(header), Some(About::End(_)))
}

fn is_of(node: NodeAddress, header: &Header) -> bool {
    node_of(header) == node
}

impl ClassQueue {
    /// Keeps an event that is [about](About) a node behind the queued messages that it must follow. The end
    /// of a node follows all messages of that node, which now precede all others. Any other event follows the
    /// events about the node's end. Returns the event if it need not wait.
    ///
    /// The event occupies no position of a class: the caller must limit the [kept events](Self::events_behind).
    pub fn queue_behind(&mut self, event: Message) -> Option<Message> {
        let length = event.payload.len();
        let event = self.place_behind(event, Place::Behind);
        if event.is_none() {
            self.add(length);
        }
        event
    }

    /// Returns whether [`queue_behind`](Self::queue_behind) would keep the event with this header.
    #[must_use]
    pub fn queues_behind(&self, event: &Header) -> bool {
        let waits_in_a_lane = |node| self.lanes.iter().flatten().any(|message| is_of(node, &message.header));
        match About::of(event) {
            Some(About::End(node)) => self.ends.has_any_of(node) || waits_in_a_lane(node),
            Some(About::Node(node)) => self.ends.has_any_of(node),
            None => false,
        }
    }

    /// Returns the number of events that are [kept behind](Self::queue_behind) messages.
    #[must_use]
    pub const fn events_behind(&self) -> usize {
        self.ends.behind.messages
    }

    /// Same as [`queue_behind`](Self::queue_behind), for an event with bytes that are already counted.
    #[inline]
    pub(super) fn place_behind(&mut self, event: Message, place: Place) -> Option<Message> {
        let Some(about) = About::of(&event.header) else { return Some(event) };
        if let About::End(node) = about {
            self.bring_forward(node);
        }
        if !self.ends.has_any_of(about.node()) {
            return Some(event);
        }
        self.ends.push(place, event);
        None
    }

    /// Moves the queued messages of this node and events about it before all others. The classes are kept in
    /// order, and the messages in each class.
    fn bring_forward(&mut self, node: NodeAddress) {
        for (lane, bytes) in self.lanes.iter_mut().zip(&mut self.bytes) {
            if !lane.iter().any(|message| is_of(node, &message.header)) {
                continue;
            }
            for message in std::mem::take(lane) {
                if is_of(node, &message.header) {
                    *bytes -= message.payload.len();
                    self.ends_in_lanes -= usize::from(is_end(&message.header));
                    self.ends.push(Place::Lane, message);
                } else {
                    lane.push_back(message);
                }
            }
        }
    }

    /// Puts a popped message back before its node's remaining messages and end, which are later. Returns the
    /// message if there are none.
    pub(super) fn put_back_before_end(&mut self, message: Message) -> Option<Message> {
        let node = node_of(&message.header);
        // Usually there is none: then no message is examined, for any queue length.
        if self.ends_in_lanes > 0 {
            let is_its_end = |other: &Message| About::of(&other.header) == Some(About::End(node));
            if self.lanes.iter().flatten().any(is_its_end) {
                self.bring_forward(node);
            }
        }
        if !self.ends.has_any_of(node) {
            return Some(message);
        }
        self.ends.push_first(message);
        None
    }

    /// Removes the layers' events that wait behind messages.
    pub(super) fn take_events(&mut self) -> Vec<Message> {
        let events = self.ends.remove_if(|message| is_event(&message.header));
        self.release(events.iter().map(|event| event.payload.len()).sum());
        events
    }
}
