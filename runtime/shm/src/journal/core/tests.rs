//! The protocol on one thread: every length, overwriting, dead writers, and memory of any content. Runs under Miri too.

use std::sync::atomic::Ordering;

use proptest::prelude::*;

use super::{
    super::layout::{ALIGN, Head, PLACE_WORDS, RECORD_HEAD, payload_max, record_bytes},
    Memory,
    channels::{self, ChannelKey},
    model::{Model, SALT},
    reader::{Next, ReaderCore},
    writer::{begin, reserve},
};

const RING: u64 = 1024;
const CASES: u32 = if cfg!(miri) { 3 } else { 300 };

fn payload(number: u64, length: usize) -> Vec<u8> {
    (0..length).map(|byte| (number as usize * 31 + byte) as u8).collect()
}

/// Returns the numbers of all records that are there, each with its own payload.
fn read(reader: &mut ReaderCore, model: &Model, now: u64) -> Vec<u64> {
    let (mut bytes, mut numbers) = (Vec::new(), Vec::new());
    while let Ok(Next::Record(found)) = reader.next(model, now, &mut bytes) {
        assert_eq!(bytes, payload(found.head.number, found.head.length as usize));
        numbers.push(found.head.number);
    }
    numbers
}

proptest! {
    #![proptest_config(ProptestConfig { cases: CASES, failure_persistence: None, ..ProptestConfig::default() })]

    /// A reader has every record, in order, unless a whole ring was written meanwhile. Then it has the newest ones.
    #[test]
    fn every_record_is_read_until_it_is_overwritten(
        steps in proptest::collection::vec(proptest::option::weighted(0.8, 0..payload_max(RING)), 1..120),
    ) {
        let model = Model::new(1, RING);
        let mut reader = ReaderCore::new(RING, SALT, 0, true);
        let (mut number, mut waiting, mut expected) = (0, 0, Vec::new());
        for step in steps {
            if let Some(length) = step {
                number += 1;
                model.write(number, &payload(number, length));
                waiting += record_bytes(length);
                expected.push(number);
                continue;
            }
            let before = reader.counts.overruns;
            let seen = read(&mut reader, &model, 0);
            if waiting <= RING {
                prop_assert_eq!(&seen, &expected);
            } else {
                prop_assert_eq!(reader.counts.overruns, before + 1);
                prop_assert!(expected.ends_with(&seen));
            }
            (waiting, expected) = (0, Vec::new());
        }
        prop_assert_eq!(reader.counts.damaged, 0);
    }

    /// For any content of the memory, and any change of it: only records with a right checksum are returned, and
    /// the call ends.
    #[test]
    fn any_memory_gives_records_or_nothing(
        writes in proptest::collection::vec(0..payload_max(RING), 1..20),
        changes in proptest::collection::vec((0..RING / 8, any::<u64>(), 0..6_u8), 1..60),
        reserved in proptest::option::of(any::<u64>()),
        patience in 0..2_u64,
    ) {
        let model = Model::new(1, RING);
        for (number, length) in (1..).zip(writes) {
            model.write(number, &payload(number, length));
        }
        let mut reader = ReaderCore::new(RING, SALT, model.reserved().load(Ordering::Relaxed), true);
        reader.patience = patience;
        for (place, value, like) in changes {
            let word = &model.ring()[place as usize];
            let position = place * 8 / ALIGN * ALIGN;
            match like {
                0 => word.store(value, Ordering::Relaxed),
                1 => word.store(value % 2048, Ordering::Relaxed),
                2 => word.store((position ^ SALT) | 1, Ordering::Relaxed),
                3 => word.store((position ^ SALT) | 2, Ordering::Relaxed),
                4 => word.store(word.load(Ordering::Relaxed) ^ (1 << (value % 64)), Ordering::Relaxed),
                _ => word.store(u64::MAX, Ordering::Relaxed),
            }
            let _ = read(&mut reader, &model, place);
        }
        if let Some(reserved) = reserved {
            model.reserved().store(reserved, Ordering::Relaxed);
            let _ = read(&mut reader, &model, u64::MAX);
            let mut late = ReaderCore::new(RING, SALT, reserved, true);
            let _ = read(&mut late, &model, u64::MAX);
        }
    }

    /// Of all bits of a record, each that changes is noticed.
    #[test]
    fn changed_bit_is_noticed(length in 0..100_usize, bit in any::<usize>()) {
        let model = Model::new(1, RING);
        model.write(1, &payload(1, length));
        model.write(2, &payload(2, 8));
        // Bytes that only fill the last word have no meaning.
        let bits = (RECORD_HEAD + length) * 8;
        let (word, bit) = (bit % bits / 64, bit % bits % 64);
        let word = &model.ring()[word];
        word.store(word.load(Ordering::Relaxed) ^ 1 << bit, Ordering::Relaxed);
        let mut reader = ReaderCore::new(RING, SALT, 0, true);
        prop_assert_eq!(read(&mut reader, &model, 0), [2]);
        prop_assert_eq!(reader.counts.damaged + reader.counts.unfinished, 1);
    }
}

#[test]
fn unfinished_record_is_awaited_then_skipped() {
    let model = Model::new(1, RING);
    model.write(1, &payload(1, 10));
    let dying = reserve(&model, Head { length: 100, place: 0, number: 2, time: 2 });
    // Not even announced: its bytes are zeros.
    reserve(&model, Head { length: 200, place: 0, number: 3, time: 3 });
    begin(&model, dying, SALT);
    model.write(4, &payload(4, 10));
    let mut reader = ReaderCore::new(RING, SALT, 0, true);
    reader.patience = 1_000;
    assert_eq!(read(&mut reader, &model, 5_000), [1]);
    assert_eq!(read(&mut reader, &model, 5_999), [0; 0]);
    assert_eq!(read(&mut reader, &model, 6_000), [0; 0], "it waits for the second one");
    assert_eq!(read(&mut reader, &model, 7_000), [4]);
    assert_eq!(reader.counts.unfinished, 2);
}

#[test]
fn oldest_whole_record_of_a_full_ring_is_found() {
    let model = Model::new(1, RING);
    for number in 1..=100 {
        model.write(number, &payload(number, number as usize));
    }
    let mut reader = ReaderCore::new(RING, SALT, model.reserved().load(Ordering::Relaxed), true);
    let seen = read(&mut reader, &model, 0);
    assert_eq!(seen, (100 - seen.len() as u64 + 1..=100).collect::<Vec<_>>());
    // Records of 100 bytes take 160: six are whole.
    assert_eq!(seen.len(), 6);
}

#[test]
fn file_full_of_false_records_is_given_up() {
    let model = Model::new(1, 64 * 1024);
    model.reserved().store(64 * 1024, Ordering::Relaxed);
    for (index, word) in (0_u64..).zip(model.ring()) {
        let position = index * 8;
        let value = if position % ALIGN == 0 { (position ^ SALT) | 2 } else { 16_000 };
        word.store(value, Ordering::Relaxed);
    }
    let mut reader = ReaderCore::new(64 * 1024, SALT, 64 * 1024, true);
    assert!(matches!(reader.next(&model, 0, &mut Vec::new()), Ok(Next::Damaged(_))));
    assert!(reader.counts.damaged < 20);
}

#[test]
fn channels_beyond_the_table_share_the_last_place() {
    let model = Model::new(9, RING);
    let places: Vec<_> =
        (0..40).map(|number| channels::count(model.table(), ChannelKey([number, 0, 0]), 2).0).collect();
    assert!(places[8..].iter().all(|place| *place == 8), "{places:?}");
    assert_eq!(channels::count(model.table(), ChannelKey([3, 0, 0]), 0), (places[3], 2));
    let seen = model.table().chunks(PLACE_WORDS).map(|place| place[channels::SEEN].load(Ordering::Relaxed));
    assert_eq!(seen.sum::<u64>(), 80);
}
