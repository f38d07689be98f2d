//! The contents, the counters and the order of a queue.

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
fn newest_stream_value_takes_the_place_of_the_older() {
    let mut queue = ClassQueue::new(4);
    queue.push(message(Class::Stream, 7, 1)).unwrap();
    queue.push(message(Class::Stream, 8, 2)).unwrap();
    let superseded = queue.push(message(Class::Stream, 7, 3)).unwrap();
    assert_eq!(superseded.map(|m| m.header.sequence), Some(1));
    let order: Vec<_> = std::iter::from_fn(|| queue.pop()).map(|m| m.header.sequence).collect();
    assert_eq!(order, [3, 2]);
}

#[test]
fn endless_control_traffic_does_not_stop_bulk() {
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

fn long(class: Class, source: u32, length: usize) -> Message {
    let Message { header, .. } = message(class, source, 0);
    Message::new(header, vec![0; length].into())
}

#[test]
fn byte_limit_applies_to_each_class() {
    let mut queue = ClassQueue::new(Bounds { messages: 8, bytes: 100 });
    queue.push(long(Class::Bulk, 1, 60)).unwrap();
    queue.push(long(Class::Bulk, 1, 40)).unwrap();
    let refused = queue.push(long(Class::Bulk, 1, 1)).unwrap_err();
    assert_eq!((refused.why, refused.message.payload.len()), (Rejection::QueueFull, 1));
    queue.push(long(Class::Bulk, 1, 0)).unwrap();
    queue.push(long(Class::Control, 1, 100)).unwrap();
    assert_eq!(queue.bytes(), 200);
    queue.pop();
    queue.pop();
    queue.push(long(Class::Bulk, 1, 60)).unwrap();
    assert_eq!(queue.bytes(), 100);
}

#[test]
fn single_message_fits_however_long_it_is() {
    let mut queue = ClassQueue::new(Bounds { messages: 8, bytes: 10 });
    queue.push(long(Class::Control, 1, 1_000)).unwrap();
    assert!(queue.push(long(Class::Control, 1, 1)).is_err());
    queue.push(long(Class::Stream, 1, 1_000)).unwrap();
    queue.push(long(Class::Stream, 1, 2_000)).unwrap();
    assert_eq!((queue.len(), queue.bytes()), (2, 3_000));
}

#[test]
fn replacement_counts_the_newer_value_and_needs_room() {
    let mut queue = ClassQueue::new(Bounds { messages: 8, bytes: 100 });
    queue.push(long(Class::Stream, 1, 50)).unwrap();
    queue.push(long(Class::Stream, 2, 50)).unwrap();
    queue.push(long(Class::Stream, 1, 50)).unwrap();
    assert!(queue.push(long(Class::Stream, 1, 51)).is_err());
    assert_eq!((queue.len(), queue.bytes()), (2, 100));
    queue.push(long(Class::Stream, 1, 10)).unwrap();
    queue.push(long(Class::Stream, 3, 40)).unwrap();
    assert_eq!((queue.len(), queue.bytes()), (3, 100));
}

proptest! {
    #[test]
    fn counted_bytes_equal_waiting_bytes_within_the_bound(
        inputs in proptest::collection::vec((0usize..3, 0u32..3, 0usize..40, 0u8..8), 0..200),
    ) {
        const BOUNDS: Bounds = Bounds { messages: 6, bytes: 64 };
        let budget = Budget::new(150);
        let mut queue = ClassQueue::sharing(BOUNDS, budget.clone());
        for (now, (class, source, length, step)) in (1u64..).zip(inputs) {
            let mut message = long(Class::ALL[class], source, length);
            (message.header.sent, message.header.time_to_live_us) = (Time::from_nanos(now * 1_000), 20);
            match step {
                0..5 => {
                    let older = queue.bytes[class];
                    if queue.push(message).is_ok() {
                        prop_assert!(older == 0 || queue.bytes[class] <= BOUNDS.bytes);
                    } else {
                        prop_assert_eq!(queue.bytes[class], older);
                    }
                }
                5 => drop(queue.pop()),
                6 => drop(queue.take_expired(Time::from_nanos(now * 1_000))),
                _ => if let Some(popped) = queue.pop() { queue.put_back(popped); },
            }
            for (lane, counted) in queue.lanes.iter().zip(queue.bytes) {
                prop_assert_eq!(lane.iter().map(|message| message.payload.len()).sum::<usize>(), counted);
                prop_assert!(lane.len() <= BOUNDS.messages);
            }
            prop_assert!(budget.held() == queue.bytes() && budget.held() <= 150);
        }
        let counted = queue.bytes();
        prop_assert_eq!(queue.drain_all().map(|message| message.payload.len()).sum::<usize>(), counted);
        prop_assert_eq!((queue.bytes(), queue.len(), budget.held()), (0, 0, 0));
        queue.push(long(Class::Bulk, 1, 40)).unwrap();
        prop_assert_eq!(budget.held(), 40);
        drop(queue);
        prop_assert_eq!(budget.held(), 0);
    }

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
