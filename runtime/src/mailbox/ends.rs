//! What is left of nodes that are gone, in a queue: each node's messages, and behind them what is said of its end.

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

/// Messages, and the bytes of their payloads.
#[derive(Clone, Copy, Debug, Default, PartialEq, Eq)]
pub(super) struct Held {
    pub(super) messages: usize,
    pub(super) bytes: usize,
}

impl Held {
    const fn count(&mut self, message: &Message) {
        self.messages += 1;
        self.bytes += message.payload.len();
    }

    const fn count_out(&mut self, message: &Message) {
        self.messages -= 1;
        self.bytes -= message.payload.len();
    }
}

/// Whose place a message holds until it is taken.
#[derive(Clone, Copy, Debug, PartialEq, Eq)]
pub(super) enum Place {
    /// One of its class's lane.
    Lane,
    /// One beside the lanes: an event that is [kept behind](ClassQueue::keep_behind) messages.
    Kept,
}

/// Messages that go before all others, in their order. Each holds its place as if it still waited where it came from: what is brought
/// here makes no room for more.
#[derive(Debug, Default)]
pub(super) struct Ends {
    messages: VecDeque<(Place, Message)>,
    /// Of each class, what holds a place of its lane.
    of_lanes: [Held; 3],
    kept: Held,
}

impl Ends {
    fn push(&mut self, place: Place, message: Message) {
        self.held_in(place, &message).count(&message);
        self.messages.push_back((place, message));
    }

    fn push_first(&mut self, message: Message) {
        self.held_in(Place::Lane, &message).count(&message);
        self.messages.push_front((Place::Lane, message));
    }

    pub(super) fn pop(&mut self) -> Option<Message> {
        let (place, next) = self.messages.pop_front()?;
        self.held_in(place, &next).count_out(&next);
        Some(next)
    }

    const fn held_in(&mut self, place: Place, message: &Message) -> &mut Held {
        match place {
            Place::Lane => &mut self.of_lanes[message.header.class as usize],
            Place::Kept => &mut self.kept,
        }
    }

    pub(super) fn iter(&self) -> impl ExactSizeIterator<Item = &Message> {
        self.messages.iter().map(|(_, message)| message)
    }

    /// What holds places of the lane of this class.
    pub(super) const fn of_lane(&self, class: usize) -> Held {
        self.of_lanes[class]
    }

    pub(super) fn bytes(&self) -> usize {
        self.kept.bytes + self.of_lanes.iter().map(|held| held.bytes).sum::<usize>()
    }

    pub(super) fn take_all(&mut self) -> impl Iterator<Item = Message> + use<> {
        std::mem::take(self).messages.into_iter().map(|(_, message)| message)
    }

    /// Takes out those of which this is true.
    fn take_those(&mut self, is_it: impl Fn(&Message) -> bool) -> Vec<Message> {
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

    /// Takes out what has expired by `now`; returns when the next of the rest does.
    pub(super) fn take_expired(&mut self, now: Time, expired: &mut Vec<Message>) -> Time {
        expired.extend(self.take_those(|message| message.header.is_expired(now)));
        self.iter().map(|message| message.header.expiry()).min().unwrap_or(Time::MAX)
    }

    pub(super) fn take_request(&mut self, ticket: Ticket) -> Option<Message> {
        let at = self.messages.iter().rposition(|(_, message)| message.is_request(ticket))?;
        let (place, request) = self.messages.remove(at)?;
        self.held_in(place, &request).count_out(&request);
        Some(request)
    }

    /// Whether something of this node is here, or is said of it.
    fn has_any_of(&self, node: NodeAddress) -> bool {
        self.iter().any(|message| is_of(node, &message.header))
    }

    /// Whether a value of this stream is here. One that comes now does not take its place: an end is between them.
    pub(super) fn has_value_of(&self, stream: &Header) -> bool {
        let is_one = |header: &Header| header.class == Class::Stream && is_same_stream(header, stream);
        self.iter().any(|message| is_one(&message.header))
    }
}

/// The node that this is of, or is said of.
fn node_of(header: &Header) -> NodeAddress {
    About::of(header).map_or(header.source.node, About::node)
}

/// Whether this is said of a node's end.
pub(super) fn is_end(header: &Header) -> bool {
    matches!(About::of(header), Some(About::End(_)))
}

fn is_of(node: NodeAddress, header: &Header) -> bool {
    node_of(header) == node
}

impl ClassQueue {
    /// Keeps an event that is [about](About) a node behind what waits here of it: of its end, behind all of its messages, which go before
    /// all others now; of anything else, behind what is said of its end. Hands it back where it has nothing to wait for.
    ///
    /// It holds no place of a class: who keeps events bounds how many are [kept](Self::kept_events).
    pub fn keep_behind(&mut self, event: Message) -> Option<Message> {
        let length = event.payload.len();
        let event = self.place_behind(event, Place::Kept);
        if event.is_none() {
            self.add(length);
        }
        event
    }

    /// Whether [`keep_behind`](Self::keep_behind) would keep the event with this header.
    #[must_use]
    pub fn keeps(&self, event: &Header) -> bool {
        let waits_in_a_lane = |node| self.lanes.iter().flatten().any(|message| is_of(node, &message.header));
        match About::of(event) {
            Some(About::End(node)) => self.ends.has_any_of(node) || waits_in_a_lane(node),
            Some(About::Node(node)) => self.ends.has_any_of(node),
            None => false,
        }
    }

    /// Events that are [kept behind](Self::keep_behind) messages.
    #[must_use]
    pub const fn kept_events(&self) -> usize {
        self.ends.kept.messages
    }

    /// The same of one whose bytes are counted.
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

    /// What waits of this node, or is said of it, goes before all others, in the order of the classes, each class in its own.
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

    /// Puts a message back that was popped, before what is left of its node and is said of its end: that came later. Hands it back where
    /// nothing is.
    pub(super) fn put_back_before_end(&mut self, message: Message) -> Option<Message> {
        let node = node_of(&message.header);
        // Nearly always there is none: then nothing is looked at, however much waits.
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

    /// Takes out the layers' events that wait behind messages.
    pub(super) fn take_events(&mut self) -> Vec<Message> {
        let events = self.ends.take_those(|message| is_event(&message.header));
        self.give(events.iter().map(|event| event.payload.len()).sum());
        events
    }
}
