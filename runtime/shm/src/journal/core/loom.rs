//! Checks interleavings of a journal's writers and a reader, and every value that a processor may show meanwhile.
//!
//! `RUSTFLAGS="--cfg loom" cargo test --release -p sinew-shm --lib --target-dir target/loom core::loom`

use std::sync::{Arc, atomic::Ordering};

use loom::thread;

use super::{
    super::layout::{Head, PLACE_WORDS},
    Memory,
    channels::{self, ChannelKey},
    model::{Model, SALT},
    reader::{Next, ReaderCore},
    writer::{begin, finish, reserve},
};

/// Bytes of a ring with four records of 8 bytes: the shortest in which such a payload is allowed.
const RING: u64 = 256;

fn payload(number: u64) -> [u8; 8] {
    [number as u8; 8]
}

/// Returns the numbers of all records that are there. A record is whole, or is not returned.
fn read(reader: &mut ReaderCore, model: &Model) -> Vec<u64> {
    let (mut bytes, mut numbers) = (Vec::new(), Vec::new());
    while let Ok(Next::Record(found)) = reader.next(model, 0, &mut bytes) {
        assert_eq!(bytes, payload(found.head.number));
        assert_eq!(found.head.time, found.head.number);
        numbers.push(found.head.number);
    }
    numbers
}

#[test]
fn record_is_whole_or_not_there() {
    loom::model(|| {
        let model = Arc::new(Model::new(1, RING));
        let writing = Arc::clone(&model);
        let writer = thread::spawn(move || writing.write(1, &payload(1)));
        let mut reader = ReaderCore::new(RING, SALT, 0, true);
        reader.patience = u64::MAX;
        let mut seen = read(&mut reader, &model);
        writer.join().unwrap();
        seen.extend(read(&mut reader, &model));
        assert_eq!((seen, reader.counts.damaged), (vec![1], 0));
    });
}

#[test]
fn two_writers_have_a_place_each() {
    loom::model(|| {
        let model = Arc::new(Model::new(1, RING));
        let writers: Vec<_> = (1..=2)
            .map(|number| {
                let model = Arc::clone(&model);
                thread::spawn(move || model.write(number, &payload(number)))
            })
            .collect();
        writers.into_iter().for_each(|writer| writer.join().unwrap());
        let mut seen = read(&mut ReaderCore::new(RING, SALT, 0, true), &model);
        seen.sort_unstable();
        assert_eq!(seen, [1, 2]);
    });
}

/// The checksum is left out of this test: the reservation alone must show that bytes were overwritten.
#[test]
fn overwritten_bytes_are_noticed() {
    loom::model(|| {
        let model = Arc::new(Model::new(1, RING));
        (1..=4).for_each(|number| model.write(number, &payload(number)));
        let writing = Arc::clone(&model);
        let writer = thread::spawn(move || writing.write(5, &payload(5)));
        let (first, reserved) = (model.ring()[5].load(Ordering::Relaxed), model.reserved());
        // As in `ReaderCore::refill`.
        crate::memory::fence(Ordering::Acquire);
        if first != u64::from_ne_bytes(payload(1)) {
            assert!(reserved.load(Ordering::Relaxed) > RING, "the writer has reserved this place");
        }
        writer.join().unwrap();
    });
}

#[test]
fn writer_that_dies_is_skipped() {
    loom::model(|| {
        let model = Arc::new(Model::new(1, RING));
        let dying = Arc::clone(&model);
        let writer = thread::spawn(move || {
            let reserved = reserve(&*dying, Head { length: 8, place: 0, number: 1, time: 1 });
            begin(&*dying, reserved, SALT);
        });
        model.write(2, &payload(2));
        writer.join().unwrap();
        let mut reader = ReaderCore::new(RING, SALT, 0, true);
        assert_eq!(read(&mut reader, &model), [2]);
        assert_eq!(reader.counts.unfinished, 1);
        let finished = reserve(&*model, Head { length: 8, place: 0, number: 3, time: 3 });
        begin(&*model, finished, SALT);
        finish(&*model, finished, &[&payload(3)], SALT);
        assert_eq!(read(&mut reader, &model), [3]);
    });
}

#[test]
fn channel_has_one_place_and_counts_each_message() {
    loom::model(|| {
        let model = Arc::new(Model::new(3, RING));
        let key = ChannelKey([1, 2, 3]);
        let counting = Arc::clone(&model);
        let other = thread::spawn(move || channels::count(counting.table(), key, 1));
        let own = channels::count(model.table(), key, 1);
        let other = other.join().unwrap();
        assert_eq!(own.0, other.0);
        assert_eq!(own.1 + other.1, 3, "the numbers 1 and 2");
        let places = model.table().chunks(PLACE_WORDS);
        let seen: u64 = places.map(|place| place[channels::SEEN].load(Ordering::Relaxed)).sum();
        assert_eq!(seen, 2);
    });
}
