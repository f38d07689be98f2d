//! What is left of nodes that are gone, in a queue: each node's messages, and behind them what is said of its end.

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

#[cfg(test)]
mod tests {
    use bytes::Bytes;
    use proptest::prelude::*;

    use super::*;
    use crate::{
        tid::{AppAddress, NodeAddress, Tid},
        wire::{Class, Header, Kind},
    };

    const HERE: NodeAddress = NodeAddress::new(1);
    const GONE: NodeAddress = NodeAddress::new(2);
    const OTHER: NodeAddress = NodeAddress::new(3);

    fn of(node: NodeAddress, class: Class, sequence: u64) -> Message {
        let from = Tid::new(node, AppAddress::fixed(1).unwrap());
        let mut header =
            Header::new(Kind::named("test"), from, Tid::new(HERE, AppAddress::fixed(2).unwrap()));
        (header.class, header.sequence) = (class, sequence);
        Message::new(header, Bytes::from_static(b"word"))
    }

    fn event(about: About, sequence: u64) -> Message {
        let mut event = of(HERE, Class::Control, sequence);
        event.header.source.app = AppAddress::NDL;
        about.write(&mut event.header);
        event
    }

    fn all(queue: &mut ClassQueue) -> Vec<u64> {
        std::iter::from_fn(|| queue.pop()).map(|message| message.header.sequence).collect()
    }

    #[test]
    fn what_is_said_of_a_nodes_end_comes_behind_its_messages_of_every_class_and_before_all_others() {
        let mut queue = ClassQueue::new(8);
        let classes = [Class::Bulk, Class::Stream, Class::Control];
        for (number, class) in classes.into_iter().enumerate() {
            queue.push(of(OTHER, class, 10 + number as u64)).unwrap();
            queue.push(of(GONE, class, 20 + number as u64)).unwrap();
        }
        queue.push(event(About::End(GONE), 99)).unwrap();
        queue.push(event(About::Node(GONE), 100)).unwrap();
        queue.push(of(GONE, Class::Control, 30)).unwrap();
        assert_eq!((queue.len(), queue.bytes(), queue.len_of(Class::Bulk)), (9, 36, 2));
        assert_eq!(all(&mut queue), [22, 21, 20, 99, 100, 12, 30, 11, 10]);
        assert!(queue.is_empty() && queue.bytes() == 0);
    }

    #[test]
    fn an_event_that_has_nothing_to_wait_for_is_like_any_other() {
        let mut queue = ClassQueue::new(8);
        queue.push(of(OTHER, Class::Control, 1)).unwrap();
        assert!(queue.keep_behind(event(About::End(GONE), 2)).is_some());
        queue.push(of(GONE, Class::Control, 3)).unwrap();
        assert!(queue.keep_behind(event(About::Node(GONE), 4)).is_some(), "it is not its end");
        queue.push(event(About::Node(GONE), 5)).unwrap();
        assert_eq!(all(&mut queue), [1, 3, 5]);
    }

    #[test]
    fn events_that_wait_behind_messages_are_forgotten_like_others_and_the_messages_stay() {
        let mut queue = ClassQueue::new(8);
        queue.push(of(GONE, Class::Bulk, 1)).unwrap();
        assert!(queue.keep_behind(event(About::End(GONE), 2)).is_none());
        assert_eq!(queue.take_events().len(), 1);
        assert_eq!((queue.len(), queue.bytes()), (1, 4));
        assert_eq!(all(&mut queue), [1]);
    }

    proptest! {
        /// However they come: of each node nothing comes behind its end that came before it, and each class stays in order.
        #[test]
        fn ends_are_ends(steps in proptest::collection::vec((0u8..5, 0usize..3), 1..100)) {
            let mut queue = ClassQueue::new(1_000);
            for (sequence, (what, class)) in (1..).zip(steps) {
                let node = if what % 2 == 0 { GONE } else { OTHER };
                let message = match what {
                    0 | 1 => of(node, [Class::Control, Class::Stream, Class::Bulk][class], sequence),
                    2 | 3 => event(About::End(node), sequence),
                    _ => {
                        queue.pop();
                        continue;
                    }
                };
                queue.push(message).unwrap();
            }
            let mut said = Vec::new();
            let mut last = std::collections::BTreeMap::new();
            while let Some(Message { header, .. }) = queue.pop() {
                if let Some(about) = About::of(&header) {
                    said.push((about.node(), header.sequence));
                    continue;
                }
                let node = header.source.node;
                let is_late = said.iter().any(|(of, at)| *of == node && *at > header.sequence);
                prop_assert!(!is_late, "{} comes after the end", header.sequence);
                let before = last.insert((node, header.class), header.sequence);
                prop_assert!(before.is_none_or(|before| before < header.sequence));
            }
            prop_assert_eq!(queue.bytes(), 0);
        }
    }
}
