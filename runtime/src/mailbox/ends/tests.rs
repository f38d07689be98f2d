//! What is said of a node's end, and where it stands in a queue.

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
    router::Outlet,
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

#[test]
fn what_goes_before_all_others_holds_its_classs_places_until_it_is_taken() {
    let mut queue = ClassQueue::new(Bounds { messages: 2, bytes: 8 });
    for round in 0..3 {
        queue.push(of(GONE, Class::Bulk, round)).unwrap();
        queue.push(of(GONE, Class::Bulk, round)).unwrap();
        assert!(queue.keep_behind(event(About::End(GONE), 9)).is_none());
        let refused = queue.push(of(GONE, Class::Bulk, round)).unwrap_err();
        assert!(!queue.has_room_for(&refused.message) && queue.kept_events() == 1);
        assert_eq!(all(&mut queue), [round, round, 9]);
    }
}

#[test]
fn who_waits_for_room_is_not_woken_by_what_is_only_brought_forward() {
    let mut queue = ClassQueue::new(2);
    queue.push(of(GONE, Class::Bulk, 1)).unwrap();
    queue.push(of(GONE, Class::Bulk, 2)).unwrap();
    assert!(queue.offered(&of(OTHER, Class::Bulk, 3), Waker::noop()).is_none());
    assert!(queue.keep_behind(event(About::End(GONE), 4)).is_none());
    assert!(queue.room_made().is_none());
    queue.pop();
    assert!(queue.room_made().is_some());
}

#[test]
fn what_is_put_back_comes_before_what_was_said_of_its_nodes_end_meanwhile() {
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
fn of_a_stream_the_newer_value_wins_also_where_it_was_brought_forward() {
    let mut queue = ClassQueue::new(8);
    queue.push(of(GONE, Class::Stream, 1)).unwrap();
    let older = queue.pop().unwrap();
    queue.push(of(GONE, Class::Stream, 2)).unwrap();
    queue.push(event(About::End(GONE), 3)).unwrap();
    assert!(queue.supersedes(&older.header));
    assert!(queue.put_back(older).is_some());
    // What the next life says takes nobody's place.
    assert!(queue.push(of(GONE, Class::Stream, 4)).unwrap().is_none());
    assert_eq!(all(&mut queue), [2, 3, 4]);
}

#[test]
fn what_is_said_of_ends_in_the_lanes_is_counted_on_every_way_in_and_out() {
    let said_of = |class, sequence| {
        let mut event = event(About::End(GONE), sequence);
        event.header.class = class;
        event
    };
    let mut queue = ClassQueue::new(8);
    let counts = |queue: &ClassQueue, expected| {
        assert_eq!((queue.ends_in_lanes, ends_in_lanes(queue)), (expected, expected));
    };
    // Of class Stream one takes the other's place.
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

/// Looks at the order in which messages are taken: of each node nothing comes behind its end that came before it.
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

/// How much is said of ends in the lanes, found by looking.
fn ends_in_lanes(queue: &ClassQueue) -> usize {
    queue.lanes.iter().flatten().filter(|message| is_end(&message.header)).count()
}

const BOUNDS: Bounds = Bounds { messages: 6, bytes: 20 };

proptest! {
    /// As on the way to a client: events are messages of class Control like any others.
    #[test]
    fn a_queue_holds_no_more_than_its_bounds_however_often_nodes_end(
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
                // What is put back has room beyond the bound.
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
            (0, Held::default(), Held::default(), Held::default()));
    }

    /// As in an application's mailbox, also while it is paused: then nothing is taken but events that go ahead.
    #[test]
    fn a_mailbox_holds_no_more_than_its_bounds_however_often_nodes_end(
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
                // One may be in hand; events are of class Control.
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

    /// What ends a pause is told in it, whatever waits for the end of it.
    #[test]
    fn an_event_that_need_not_wait_has_room_in_a_pause_whatever_is_kept(capacity in 1usize..9, ends in 0u64..40) {
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
