//! What is left of nodes that are gone, in a queue: each node's messages, and behind them what is said of its end.

#[cfg(test)]
mod tests;

use std::collections::{VecDeque, vec_deque};

use super::{About, ClassQueue, is_event};
use crate::{outcome::Ticket, time::Time, wire::Message};

/// Messages that go before all others, in their order.
#[derive(Debug, Default)]
pub(super) struct Ends {
    messages: VecDeque<Message>,
    bytes: usize,
}

impl Ends {
    fn push(&mut self, message: Message) {
        self.bytes += message.payload.len();
        self.messages.push_back(message);
    }

    pub(super) fn pop(&mut self) -> Option<Message> {
        let next = self.messages.pop_front()?;
        self.bytes -= next.payload.len();
        Some(next)
    }

    pub(super) fn iter(&self) -> vec_deque::Iter<'_, Message> {
        self.messages.iter()
    }

    pub(super) const fn bytes(&self) -> usize {
        self.bytes
    }

    pub(super) fn take_all(&mut self) -> VecDeque<Message> {
        std::mem::take(self).messages
    }

    /// Takes out what has expired by `now`; returns when the next of the rest does.
    pub(super) fn take_expired(&mut self, now: Time, expired: &mut Vec<Message>) -> Time {
        let mut next = Time::MAX;
        for message in self.take_all() {
            if message.header.is_expired(now) {
                expired.push(message);
            } else {
                next = next.min(message.header.expiry());
                self.push(message);
            }
        }
        next
    }

    pub(super) fn take_request(&mut self, ticket: Ticket) -> Option<Message> {
        let at = self.messages.iter().rposition(|message| message.is_request(ticket))?;
        let request = self.messages.remove(at)?;
        self.bytes -= request.payload.len();
        Some(request)
    }
}

impl ClassQueue {
    /// Keeps an event that is [about](About) a node behind what waits here of it: of its end, behind all of its messages, which go before
    /// all others now; of anything else, behind what is said of its end. Hands it back where it has nothing to wait for.
    pub fn keep_behind(&mut self, event: Message) -> Option<Message> {
        let length = event.payload.len();
        let event = self.place_behind(event);
        if let Some(budget) = self.budget.as_ref().filter(|_| event.is_none()) {
            budget.add(length);
        }
        event
    }

    /// The same of one whose bytes are counted.
    pub(super) fn place_behind(&mut self, event: Message) -> Option<Message> {
        let Some(about) = About::of(&event.header) else { return Some(event) };
        let node = about.node();
        let is_of_it = |message: &Message| match About::of(&message.header) {
            Some(about) => about.node() == node,
            None => message.header.source.node == node,
        };
        if matches!(about, About::End(_)) {
            self.bring_forward(is_of_it);
        }
        if !self.ends.iter().any(is_of_it) {
            return Some(event);
        }
        self.ends.push(event);
        None
    }

    /// Messages of which this is true go before all others, in the order of their classes, each class in its own.
    fn bring_forward(&mut self, is_it: impl Fn(&Message) -> bool) {
        for (lane, bytes) in self.lanes.iter_mut().zip(&mut self.bytes) {
            if !lane.iter().any(&is_it) {
                continue;
            }
            for message in std::mem::take(lane) {
                if is_it(&message) {
                    *bytes -= message.payload.len();
                    self.ends.push(message);
                } else {
                    lane.push_back(message);
                }
            }
        }
    }

    /// Takes out the layers' events that wait behind messages.
    pub(super) fn take_events(&mut self) -> Vec<Message> {
        let (mut events, mut given) = (Vec::new(), 0);
        for message in self.ends.take_all() {
            if is_event(&message.header) {
                given += message.payload.len();
                events.push(message);
            } else {
                self.ends.push(message);
            }
        }
        if let Some(budget) = &self.budget {
            budget.give(given);
        }
        events
    }
}
