//! Events about a node's end, and their place in a queue.

use std::{
    collections::BTreeMap,
    task::{Context, Poll, Waker},
};

use bytes::Bytes;
use proptest::{prelude::*, test_runner::TestCaseError};

use super::*;
use crate::{
    mailbox::{Bounds, Mailbox},
    outcome::Outcome,
    router::MessageSink,
    tid::{AppAddress, NodeAddress, Tid},
    wire::{Class, Header, Kind},
};

const HERE: NodeAddress = NodeAddress::new(1);
const GONE: NodeAddress = NodeAddress::new(2);
const OTHER: NodeAddress = NodeAddress::new(3);

fn of(node: NodeAddress, class: Class, sequence: u64) -> Message {
    let from = Tid::new(node, AppAddress::fixed(1).unwrap());
    let mut header = Header::new(Kind::named("test"), from, Tid::new(HERE, AppAddress::fixed(2).unwrap()));
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
fn end_event_follows_its_nodes_messages_and_precedes_others() {
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
fn end_event_without_messages_to_follow_is_ordinary() {
    let mut queue = ClassQueue::new(8);
    queue.push(of(OTHER, Class::Control, 1)).unwrap();
    assert!(queue.queue_behind(event(About::End(GONE), 2)).is_some());
    queue.push(of(GONE, Class::Control, 3)).unwrap();
    assert!(queue.queue_behind(event(About::Node(GONE), 4)).is_some(), "it is not its end");
    queue.push(event(About::Node(GONE), 5)).unwrap();
    assert_eq!(all(&mut queue), [1, 3, 5]);
}

#[test]
fn removed_events_leave_the_messages_before_them() {
    let mut queue = ClassQueue::new(8);
    queue.push(of(GONE, Class::Bulk, 1)).unwrap();
    assert!(queue.queue_behind(event(About::End(GONE), 2)).is_none());
    assert_eq!(queue.take_events().len(), 1);
    assert_eq!((queue.len(), queue.bytes()), (1, 4));
    assert_eq!(all(&mut queue), [1]);
}

#[test]
fn advanced_message_keeps_its_slot_until_taken() {
    let mut queue = ClassQueue::new(Bounds { messages: 2, bytes: 8 });
    for round in 0..3 {
        queue.push(of(GONE, Class::Bulk, round)).unwrap();
        queue.push(of(GONE, Class::Bulk, round)).unwrap();
        assert!(queue.queue_behind(event(About::End(GONE), 9)).is_none());
        queue.push(of(GONE, Class::Bulk, round)).unwrap_err();
        assert_eq!(queue.events_behind(), 1);
        assert_eq!(all(&mut queue), [round, round, 9]);
    }
}

#[test]
fn advancing_messages_does_not_wake_senders() {
    let mut queue = ClassQueue::new(2);
    queue.push(of(GONE, Class::Bulk, 1)).unwrap();
    queue.push(of(GONE, Class::Bulk, 2)).unwrap();
    assert!(queue.offered(&of(OTHER, Class::Bulk, 3), Waker::noop()).is_empty());
    assert!(queue.queue_behind(event(About::End(GONE), 4)).is_none());
    assert!(queue.room_made().is_empty());
    queue.pop();
    assert!(!queue.room_made().is_empty());
}

#[test]
fn returned_message_precedes_its_nodes_end_event() {
    for rest in [0, 1] {
        let mut queue = ClassQueue::new(8);
        queue.push(of(GONE, Class::Bulk, 1)).unwrap();
        let popped = queue.pop().unwrap();
        (0..rest).for_each(|_| drop(queue.push(of(GONE, Class::Control, 2)).unwrap()));
        queue.push(event(About::End(GONE), 3)).unwrap();
        assert!(queue.put_back(popped).is_none());
        assert_eq!(all(&mut queue), if rest == 0 { vec![1, 3] } else { vec![1, 2, 3] });
    }
}

#[test]
fn newer_stream_value_wins_also_when_advanced() {
    let mut queue = ClassQueue::new(8);
    queue.push(of(GONE, Class::Stream, 1)).unwrap();
    let older = queue.pop().unwrap();
    queue.push(of(GONE, Class::Stream, 2)).unwrap();
    queue.push(event(About::End(GONE), 3)).unwrap();
    assert!(queue.supersedes(&older.header));
    assert!(queue.put_back(older).is_some());
    // A value of the next incarnation replaces none of the former one.
    assert!(queue.push(of(GONE, Class::Stream, 4)).unwrap().is_none());
    assert_eq!(all(&mut queue), [2, 3, 4]);
}

#[test]
fn end_events_in_lanes_are_counted_on_all_paths() {
    let said_of = |class, sequence| {
        let mut event = event(About::End(GONE), sequence);
        event.header.class = class;
        event
    };
    let mut queue = ClassQueue::new(8);
    let counts = |queue: &ClassQueue, expected| {
        assert_eq!((queue.ends_in_lanes, ends_in_lanes(queue)), (expected, expected));
    };
    // Of class Stream, a newer event replaces the older one.
    queue.push(said_of(Class::Stream, 1)).unwrap();
    assert!(queue.push(said_of(Class::Stream, 2)).unwrap().is_some());
    counts(&queue, 1);
    queue.pop().unwrap();
    counts(&queue, 0);
    queue.push_beyond(said_of(Class::Bulk, 3));
    queue.push_beyond(said_of(Class::Bulk, 4));
    counts(&queue, 2);
    let popped = queue.pop_if(Class::Bulk, |_| true).unwrap();
    counts(&queue, 1);
    assert!(queue.put_back(popped).is_none());
    counts(&queue, 0);
    assert_eq!(all(&mut queue), [3, 4], "they were brought forward");
    queue.push_beyond(said_of(Class::Control, 5));
    let popped = queue.pop().unwrap();
    assert!(queue.put_back(popped).is_none());
    counts(&queue, 1);
    let mut old = said_of(Class::Bulk, 6);
    old.header.time_to_live_us = 1;
    queue.push_beyond(old);
    assert_eq!(queue.take_expired(Time::from_nanos(1_000_000)).len(), 1);
    counts(&queue, 1);
    assert_eq!(queue.drain_all().count(), 1);
    counts(&queue, 0);
}

/// Checks the order in which messages are received: no message of a node that arrived before its end follows
/// its end event.
#[derive(Default)]
struct Order {
    ends: BTreeMap<NodeAddress, u64>,
    last: BTreeMap<(NodeAddress, Class), u64>,
}

impl Order {
    fn taken(&mut self, header: &Header) -> Result<(), TestCaseError> {
        let (node, sequence) = (node_of(header), header.sequence);
        if let Some(about) = About::of(header) {
            if matches!(about, About::End(_)) {
                self.ends.insert(node, sequence);
            }
            return Ok(());
        }
        prop_assert!(
            self.ends.get(&node).is_none_or(|end| *end < sequence),
            "{sequence} comes after the end"
        );
        let before = self.last.insert((node, header.class), sequence);
        prop_assert!(before.is_none_or(|before| before < sequence), "{sequence} after {before:?}");
        Ok(())
    }
}

/// Counts the end events in the lanes by a scan.
fn ends_in_lanes(queue: &ClassQueue) -> usize {
    queue.lanes.iter().flatten().filter(|message| is_end(&message.header)).count()
}

const BOUNDS: Bounds = Bounds { messages: 6, bytes: 20 };

proptest! {
    /// As on the way to a client: events are messages of class Control like any others.
    #[test]
    fn queue_stays_within_bounds_however_often_nodes_end(
        steps in proptest::collection::vec((0u8..12, 0usize..3, any::<bool>()), 1..200),
    ) {
        let mut queue = ClassQueue::new(BOUNDS);
        let (mut order, mut hand) = (Order::default(), None::<Message>);
        for (sequence, (what, class, is_gone)) in (1..).zip(steps) {
            let node = if is_gone { GONE } else { OTHER };
            match what {
                0..6 => {
                    let mut message = of(node, Class::ALL[class], sequence);
                    message.header.sent = Time::from_nanos(sequence * 1_000);
                    message.header.time_to_live_us = if what == 0 { 5 } else { 0 };
                    let _ = queue.push(message);
                }
                6 | 7 => drop(queue.push(event(About::End(node), sequence))),
                8 => drop(queue.push(event(About::Node(node), sequence))),
                9 => drop(queue.take_expired(Time::from_nanos(sequence * 1_000))),
                10 => {
                    if let Some(message) = hand.take() {
                        order.taken(&message.header)?;
                    }
                    hand = queue.pop();
                }
                _ => if let Some(message) = hand.take() { drop(queue.put_back(message)) },
            }
            for class in 0..3 {
                // A returned message has room beyond the bound.
                prop_assert!(queue.held(class).messages <= BOUNDS.messages + 1);
                prop_assert!(queue.held(class).bytes <= BOUNDS.bytes + 4);
                prop_assert_eq!(queue.len_of(Class::ALL[class]), queue.held(class).messages);
            }
            prop_assert_eq!(queue.iter().map(|message| message.payload.len()).sum::<usize>(), queue.bytes());
            prop_assert_eq!(queue.ends_in_lanes, ends_in_lanes(&queue));
        }
        for message in hand.into_iter().chain(std::iter::from_fn(|| queue.pop())) {
            order.taken(&message.header)?;
        }
        prop_assert_eq!((queue.bytes(), queue.held(0), queue.held(1), queue.held(2)),
            (0, Usage::default(), Usage::default(), Usage::default()));
    }

    /// As in an application's mailbox, also while it is paused: then only priority events are received.
    #[test]
    fn mailbox_stays_within_bounds_however_often_nodes_end(
        steps in proptest::collection::vec((0u8..10, 0usize..3, any::<bool>()), 1..200),
    ) {
        let mailbox = Mailbox::new(BOUNDS);
        let mut reader = mailbox.attach();
        let mut cx = Context::from_waker(Waker::noop());
        let (mut order, mut is_paused) = (Order::default(), true);
        for (sequence, (what, class, is_gone)) in (1..).zip(steps) {
            let node = if is_gone { GONE } else { OTHER };
            let submitted = match what {
                0..4 => mailbox.submit(of(node, Class::ALL[class], sequence)),
                4 | 5 => mailbox.submit(event(About::End(node), sequence)),
                6 => mailbox.submit(event(About::Node(node), sequence)),
                7 => {
                    is_paused = !is_paused;
                    Ok(())
                }
                _ => {
                    let taken = if is_paused { reader.poll_event(&mut cx) } else { reader.poll_take(&mut cx) };
                    if let Poll::Ready(Some(message)) = taken {
                        reader.finish(Outcome::Delivered);
                        order.taken(&message.header)?;
                    }
                    Ok(())
                }
            };
            prop_assert!(submitted.is_ok() || mailbox.depth() > 0, "an empty one refuses nothing");
            prop_assert!(mailbox.depth() <= 4 * BOUNDS.messages, "three classes, and events");
            for class in Class::ALL {
                // One may be handled at present; events are of class Control.
                let events_max = if class == Class::Control { BOUNDS.messages } else { 0 };
                let (tally, held) = mailbox.account(class);
                prop_assert!(held <= (BOUNDS.messages + events_max + 1) as u64);
                prop_assert_eq!(tally.open(), held);
            }
        }
        while let Poll::Ready(Some(message)) = reader.poll_take(&mut cx) {
            reader.finish(Outcome::Delivered);
            order.taken(&message.header)?;
        }
    }

    /// The event that ends a pause is received during the pause, even if messages wait.
    #[test]
    fn priority_event_has_room_in_a_pause(capacity in 1usize..9, ends in 0u64..40) {
        let mailbox = Mailbox::new(capacity);
        let mut reader = mailbox.attach();
        let mut cx = Context::from_waker(Waker::noop());
        prop_assert!(reader.poll_event(&mut cx).is_pending());
        mailbox.submit(of(GONE, Class::Bulk, 1)).unwrap();
        for sequence in 0..ends {
            let _ = mailbox.submit(event(About::End(GONE), sequence));
        }
        let mut met = of(HERE, Class::Control, 2);
        met.header.source.app = AppAddress::SYNC;
        prop_assert!(mailbox.submit(met).is_ok());
        prop_assert!(reader.poll_event(&mut cx).is_ready());
        prop_assert!(mailbox.depth() <= capacity + 1);
    }

    /// For any order of arrival: no earlier message of a node follows its end event, and each class stays in
    /// order.
    #[test]
    fn no_message_follows_its_nodes_end(steps in proptest::collection::vec((0u8..5, 0usize..3), 1..100)) {
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
        let mut last = BTreeMap::new();
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
