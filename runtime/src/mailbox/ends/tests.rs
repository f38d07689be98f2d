//! What is said of a node's end, and where it stands in a queue.

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
