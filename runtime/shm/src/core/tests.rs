//! The protocol against a queue, and against a peer that writes anything. Runs under Miri too.

use std::{
    collections::VecDeque,
    sync::{Arc, atomic::Ordering},
};

use proptest::prelude::*;

use super::model::{Side, fill, read, ring};
use super::{ConsumerCore, ProducerCore};
use crate::{
    error::{CorruptError, LoanError},
    layout::{Capacity, Mark, Word},
    wait::Armed,
};

#[derive(Clone, Copy, Debug)]
enum Step {
    Publish(usize),
    PublishShortened(usize, u32),
    GiveBack(usize),
    Take,
    ArmConsumer,
    ArmProducer(usize),
}

fn step() -> impl Strategy<Value = Step> {
    prop_oneof![
        4 => (0..160_usize).prop_map(Step::Publish),
        1 => (0..160_usize, 0..160_u32).prop_map(|(asked, kept)| Step::PublishShortened(asked, kept)),
        1 => (0..160_usize).prop_map(Step::GiveBack),
        5 => Just(Step::Take),
        1 => Just(Step::ArmConsumer),
        1 => (0..160_usize).prop_map(Step::ArmProducer),
    ]
}

const CASES: u32 = if cfg!(miri) { 3 } else { 500 };

proptest! {
    #![proptest_config(ProptestConfig { cases: CASES, failure_persistence: None, ..ProptestConfig::default() })]

    /// For any order of steps: messages are received as published, in order. A ring that reports full is
    /// full, and one that reports empty is empty.
    #[test]
    fn a_ring_is_a_queue(steps in proptest::collection::vec(step(), 1..200), log in 4..9_u32) {
        let capacity = Capacity::tiny(1 << log);
        let (mut sender, mut receiver) = ring(capacity);
        let mut queue: VecDeque<(u32, u64)> = VecDeque::new();
        let mut number = 0;
        let mut asleep = false;
        for step in steps {
            match step {
                Step::Publish(length) | Step::PublishShortened(length, _) | Step::GiveBack(length) => {
                    number += 1;
                    match sender.reserve(length) {
                        Ok(reserved) => {
                            fill(&sender, reserved, number);
                            let length = match step {
                                Step::GiveBack(_) => { sender.give_back(); None }
                                Step::PublishShortened(asked, kept) => { sender.shorten(kept); Some((asked as u32).min(kept)) }
                                Step::Publish(_) | Step::Take | Step::ArmConsumer | Step::ArmProducer(_) => Some(reserved.length),
                            };
                            if let Some(length) = length {
                                let rings = sender.publish();
                                prop_assert_eq!(rings, asleep, "a ring for each sleep, and only then");
                                asleep = false;
                                queue.push_back((length, number));
                            }
                        }
                        Err(LoanError::Full { asked, free }) => {
                            prop_assert!((asked > free || free == 0) && !queue.is_empty(), "an empty ring takes all that is allowed");
                            if free > 0 {
                                prop_assert!(sender.reserve(free).is_ok(), "what is said to fit fits");
                                sender.give_back();
                            }
                        }
                        Err(LoanError::TooLong { max, .. }) => prop_assert!(length > max),
                        Err(LoanError::Corrupt(corrupt)) => prop_assert!(false, "{corrupt}"),
                    }
                }
                Step::Take => {
                    let record = receiver.next().expect("an honest peer");
                    prop_assert_eq!(record.map(|record| record.length), queue.front().map(|(length, _)| *length));
                    if let Some(record) = record {
                        receiver.disarm();
                        asleep = false;
                        let (_, number) = queue.pop_front().expect("it was there");
                        prop_assert!(read(&receiver, record).iter().all(|word| *word == number));
                        receiver.release(record);
                    }
                }
                Step::ArmConsumer => {
                    let armed = receiver.arm().expect("an honest peer");
                    prop_assert_eq!(armed == Armed::Sleep, queue.is_empty());
                    asleep = armed == Armed::Sleep;
                }
                Step::ArmProducer(length) => {
                    if let Ok(armed) = sender.arm(length) {
                        prop_assert_eq!(armed == Armed::Ready, sender.reserve(length).is_ok());
                        sender.give_back();
                        sender.disarm();
                    }
                }
            }
        }
    }

    /// For any bytes that a peer writes into its header and its ring, before or meanwhile: the result is a
    /// value or an error, and every message lies within the ring.
    #[test]
    fn any_memory_gives_messages_or_an_error(
        words in proptest::collection::vec((0..40_u32, any::<u64>(), 0..5_u8), 1..60),
    ) {
        let capacity = Capacity::tiny(256);
        let (own, peer) = (Side::new(capacity), Side::new(capacity));
        let mut receiver = ConsumerCore::new(Arc::clone(&own), Arc::clone(&peer), capacity);
        let mut sender = ProducerCore::new(own, Arc::clone(&peer), capacity);
        for (place, value, like) in words {
            // Likely values reach deeper checks than random ones.
            let small = value as u32 % 300;
            match (like, place) {
                (0, _) => peer.word(Word::Tail).store(value as u32, Ordering::Relaxed),
                (1, _) => {
                    let tail = peer.word(Word::Tail);
                    tail.store(tail.load(Ordering::Relaxed).wrapping_add(small & !7), Ordering::Relaxed);
                }
                (2, _) => peer.word(Word::Head).store(small & !7, Ordering::Relaxed),
                (3, 0..32) => peer.cell(place * 8).store(Mark::Message(small).to_bits(), Ordering::Relaxed),
                (_, 0..32) => peer.cell(place * 8).store(value, Ordering::Relaxed),
                _ => peer.cell(place % 32 * 8).store(Mark::Skip.to_bits(), Ordering::Relaxed),
            }
            for _ in 0..40 {
                let Ok(Some(record)) = receiver.next() else { break };
                prop_assert!(record.position >= 8 && record.position + record.length <= capacity.bytes());
                prop_assert!(record.length <= capacity.payload_max());
                receiver.release(record);
            }
            for length in [0, 8, 100] {
                if let Ok(reserved) = sender.reserve(length) {
                    let position = sender.payload_position(reserved);
                    prop_assert!(position >= 8 && position + reserved.length <= capacity.bytes());
                    sender.publish();
                }
            }
        }
    }
}

#[test]
fn message_that_does_not_fit_skips_to_the_start() {
    // given: 64 bytes, 40 of them used and consumed
    let (mut sender, mut receiver) = ring(Capacity::tiny(64));
    for _ in 0..2 {
        sender.reserve(8).expect("room");
        sender.publish();
    }
    sender.reserve(0).expect("room");
    sender.publish();
    while let Some(record) = receiver.next().expect("honest") {
        receiver.release(record);
    }
    // when: 32 bytes are requested, with 24 to the end
    let reserved = sender.reserve(24).expect("64 bytes are free");
    // then: they lie at the beginning
    assert_eq!(sender.payload_position(reserved), 8);
    sender.publish();
    let record = receiver.next().expect("honest").expect("published");
    assert_eq!((record.position, record.length), (8, 24));
}

#[test]
fn kept_memory_is_returned_together_with_one_wake() {
    // given: a full ring with a producer that waits for room
    let (mut sender, mut receiver) = ring(Capacity::tiny(32));
    for _ in 0..2 {
        sender.reserve(8).expect("room");
        sender.publish();
    }
    assert_eq!(sender.arm(8), Ok(Armed::Sleep));
    // when, then
    for _ in 0..2 {
        let record = receiver.next().expect("honest").expect("published");
        receiver.keep(record);
        assert_eq!(sender.arm(8), Ok(Armed::Sleep), "nothing is free");
    }
    assert_eq!(receiver.next(), Ok(None));
    assert!(receiver.give_back(), "the producer is to be woken");
    assert_eq!(sender.unread(), Ok(0));
    assert!(!receiver.give_back(), "there is nothing more");
}

#[test]
fn counts_wrap_at_32_bits() {
    // given: both halves a little before the end of counting; only whole capacities are added by hand
    let capacity = Capacity::tiny(64);
    let (mut sender, mut receiver) = ring(capacity);
    let before = 0_u32.wrapping_sub(64);
    receiver.start_at(before);
    sender.start_at(before);
    // when, then
    for number in 0..20 {
        let reserved = sender.reserve(16).expect("taken at once");
        fill(&sender, reserved, number);
        sender.publish();
        let record = receiver.next().expect("honest").expect("published");
        assert_eq!(read(&receiver, record), [number, number]);
        receiver.release(record);
    }
}

#[test]
fn error_persists_after_the_peer_repairs_its_memory() {
    // given
    let (sender, mut receiver) = ring(Capacity::tiny(64));
    sender.own.word(Word::Tail).store(4, Ordering::Relaxed);
    let corrupt = CorruptError::Tail { tail: 4, seen: 0 };
    assert_eq!(receiver.next(), Err(corrupt));
    // when
    sender.own.word(Word::Tail).store(0, Ordering::Relaxed);
    // then
    assert_eq!(receiver.next(), Err(corrupt));
}

#[test]
fn invalid_tail_or_head_is_corrupt() {
    for tail in [72, 0_u32.wrapping_sub(8), u32::MAX, 1] {
        let (sender, mut receiver) = ring(Capacity::tiny(64));
        sender.own.word(Word::Tail).store(tail, Ordering::Relaxed);
        assert_eq!(receiver.next(), Err(CorruptError::Tail { tail, seen: 0 }));
    }
    for head in [72, 0_u32.wrapping_sub(8), 3] {
        // given: 32 of 64 bytes published
        let (mut sender, receiver) = ring(Capacity::tiny(64));
        for _ in 0..2 {
            sender.reserve(8).expect("room");
            sender.publish();
        }
        receiver.own.word(Word::Head).store(head, Ordering::Relaxed);
        // when: there is room without a new check, then there is not
        sender.reserve(24).expect("the other half");
        sender.publish();
        let error = CorruptError::Head { head, seen: 0, tail: 64 };
        // then
        let refused = sender.reserve(8);
        assert_eq!(refused, Err(LoanError::Corrupt(error)), "{head}");
        assert_eq!(sender.reserve(8), Err(LoanError::Corrupt(error)), "and from then on always");
    }
}

/// Found by the hostile peer: such a message lay within the ring, but buffers of `payload_max` bytes were too
/// short for it.
#[test]
fn message_longer_than_half_the_ring_is_corrupt() {
    let (sender, mut receiver) = ring(Capacity::tiny(64));
    sender.own.cell(0).store(Mark::Message(32).to_bits(), Ordering::Relaxed);
    sender.own.word(Word::Tail).store(40, Ordering::Relaxed);
    assert_eq!(receiver.next(), Err(CorruptError::Length { length: 32, room: 32 }));
}

#[test]
fn skip_after_skip_or_to_nothing_is_corrupt() {
    for published in [64, 32] {
        let (sender, mut receiver) = ring(Capacity::tiny(64));
        sender.own.cell(0).store(Mark::Skip.to_bits(), Ordering::Relaxed);
        sender.own.word(Word::Tail).store(published, Ordering::Relaxed);
        assert_eq!(receiver.next(), Err(CorruptError::Skip { skipped: 64, published }));
    }
}

#[test]
fn peer_gets_one_ring_for_each_sleep_number() {
    // given
    let (mut sender, receiver) = ring(Capacity::tiny(256));
    receiver.own.word(Word::ConsumerSleep).store(5, Ordering::Relaxed);
    // when, then
    let rings: Vec<bool> = (0..3)
        .map(|_| {
            sender.reserve(8).expect("room");
            sender.publish()
        })
        .collect();
    assert_eq!(rings, [true, false, false]);
}
