//! Reuse and sharing of payload memory.

use std::collections::{HashSet, VecDeque};

use super::*;

fn payload(byte: u8, length: usize) -> Bytes {
    written(|writer| writer.write_all(&vec![byte; length])).unwrap()
}

fn buffers() -> usize {
    BUFFERS.with(|buffers| buffers.borrow().all.len())
}

#[test]
fn freed_payload_memory_is_reused() {
    let first = payload(1, 1000);
    let place = first.as_ptr();
    drop(first);
    assert_eq!(payload(2, 4096).as_ptr(), place);
    assert_eq!(zeroed(8).as_ptr(), place);
    assert_eq!(copied(&[1; 4096]).as_ptr(), place);
}

#[test]
fn live_payloads_never_share_memory() {
    let mut kept = Vec::new();
    for round in 0..3 {
        kept.extend((0..BUFFERS_MAX + 9).map(|n| payload(n as u8, 1 + n * 67)));
        kept.extend((0..9).map(|n| payload(n as u8, 2 * BUFFER_BYTES)));
        kept.extend((0..9).map(|n| copied(&[n as u8; 100])));
        for (n, payload) in kept.iter().enumerate() {
            assert!(payload.iter().all(|byte| *byte == payload[0]), "payload {n} in round {round}");
        }
        assert_eq!(buffers(), BUFFERS_MAX);
        // Each third one ends, so that free buffers lie between used ones.
        let mut number = 0;
        kept.retain(|_| {
            number += 1;
            number % 3 > 0
        });
    }
}

#[test]
fn few_payloads_at_once_use_few_buffers() {
    let mut in_hand = payload(0, 10);
    for n in 1..100 {
        in_hand = payload(n, in_hand.len());
    }
    assert_eq!(buffers(), 2);
}

#[test]
fn first_buffers_are_used_again_after_a_crowd() {
    let mut live: VecDeque<_> = (0..10).map(|_| payload(1, 1000)).collect();
    let first: Vec<_> = live.iter().take(FIRST).map(|payload| payload.as_ptr()).collect();
    for _ in 0..100 {
        live.push_back(payload(2, 1000));
        live.pop_front();
    }
    assert_eq!(buffers(), 11, "a free one was not found");
    live.clear();
    for _ in 0..CROWDED {
        let _ = payload(3, 1000);
    }
    assert!(first.contains(&payload(4, 1000).as_ptr()));
}

#[test]
fn copies_of_a_burst_share_buffers() {
    let copies: Vec<_> = (0..200).map(|n| copied(&[n; 1000])).collect();
    assert!(copies.iter().zip(0..).all(|(copy, n)| copy[..] == [n; 1000]));
    assert!(buffers() < 60, "{} buffers for 200 copies, of which four fit in each", buffers());
    // A buffer is free only after its last copy.
    let (places, all) = (copies.iter().map(|copy| copy.as_ptr()).collect::<HashSet<_>>(), buffers());
    let kept: Vec<_> = copies.into_iter().skip(3).step_by(4).collect();
    let later: Vec<_> = (0..100).map(|_| copied(&[9; 1000])).collect();
    assert!(kept.iter().zip((3..).step_by(4)).all(|(copy, n)| copy[..] == [n; 1000]));
    assert!(places.len() == 200 && later.iter().all(|copy| copy[..] == [9; 1000]) && buffers() >= all);
    drop((kept, later));
    for _ in 0..=CROWDED {
        let _ = copied(&[1; 1000]);
    }
    let place = copied(&[1; 1000]).as_ptr();
    assert_eq!(copied(&[1; 1000]).as_ptr(), place, "a single copy uses the first buffer again");
}

#[test]
fn free_buffer_is_found_between_used_ones() {
    let mut all: Vec<_> = (0..BUFFERS_MAX).map(|_| payload(1, 1000)).collect();
    let places: HashSet<_> = all.iter().map(|payload| payload.as_ptr()).collect();
    let mut place = 0;
    all.retain(|_| {
        place += 1;
        place <= FIRST || place % IN_TURN != 0
    });
    for _ in all.len()..BUFFERS_MAX {
        all.push(payload(2, 1000));
    }
    assert!(
        all.iter().all(|payload| places.contains(&payload.as_ptr())),
        "memory was allocated while a buffer was free"
    );
}

#[test]
fn payloads_beyond_the_buffers_get_the_memory_they_need() {
    let _used: Vec<_> = (0..BUFFERS_MAX).map(|_| payload(1, 1000)).collect();
    let capacity = || {
        let writer = Writer(Buffer::take());
        assert_eq!(writer.0.home, Home::Payload);
        writer.0.memory.capacity()
    };
    assert_eq!(capacity(), SHORT);
    let _first = payload(1, 500);
    assert_eq!(capacity(), SHORT, "a single longer one");
    let _second = payload(1, 400);
    assert_eq!(capacity(), 400);
    let _short = payload(1, 10);
    assert_eq!(capacity(), SHORT);
    let _long = [payload(1, 100_000), payload(1, 100_000)];
    assert_eq!(capacity(), BUFFER_BYTES);
}

#[test]
fn payloads_beyond_the_buffers_share_memory() {
    let _used: Vec<_> = (0..BUFFERS_MAX).map(|_| payload(1, 1000)).collect();
    // Their length is expected from the third one on.
    let written: Vec<_> = (0..10).map(|n| payload(n, 1000)).skip(2).collect();
    // The first three fill the last buffer.
    let copies: Vec<_> = (0..11).map(|n| copied(&[n; 1000])).collect();
    for (all, first, neighbours) in [(&written, 2, 3 + 3), (&copies, 0, 2 + 3 + 3)] {
        assert!(all.iter().zip(first..).all(|(one, n)| one[..] == [n; 1000]));
        let places: Vec<_> = all.iter().map(|one| one.as_ptr().addr()).collect();
        let shared = places.windows(2).filter(|two| two[1] == two[0] + 1000).count();
        assert_eq!(shared, neighbours, "four of them have room in each allocation");
    }
    let long = payload(9, BUFFER_BYTES + 1);
    assert!(long.iter().all(|byte| *byte == 9) && written[7][..] == [9; 1000]);
}

#[test]
fn freed_buffer_is_used_again_after_a_crowd() {
    let used: Vec<_> = (0..2 * BUFFERS_MAX).map(|_| payload(1, 1000)).collect();
    let places: HashSet<_> = used.iter().take(BUFFERS_MAX).map(|payload| payload.as_ptr()).collect();
    drop(used);
    let later: Vec<_> = (0..=FULL).map(|_| payload(2, 1000)).collect();
    assert!(later.last().is_some_and(|payload| places.contains(&payload.as_ptr())));
}

#[test]
fn payload_of_any_length_round_trips() {
    for length in [0, 1, BUFFER_BYTES - 1, BUFFER_BYTES, BUFFER_BYTES + 1, 100_000] {
        let bytes: Vec<u8> = (0..length).map(|n| n as u8).collect();
        let (head, tail) = bytes.split_at(length / 3);
        let payload = written(|writer| writer.write_all(head).and_then(|()| writer.write_all(tail)));
        assert_eq!(payload.unwrap(), bytes);
        assert_eq!(zeroed(length), vec![0; length]);
        assert_eq!(copied(&bytes), bytes);
    }
    assert_eq!(buffers(), 1);
}

#[test]
fn payload_code_that_sends_or_panics_leaks_no_buffer() {
    let outer = written(|writer| {
        writer.write_all(b"outer")?;
        assert_eq!(payload(7, 3), [7, 7, 7][..]);
        writer.write_all(b" whole")
    });
    assert_eq!(outer.unwrap(), b"outer whole"[..]);
    let panics = || written(|writer| writer.write_all(b"lost").map(|()| panic!("a fault of the payload's")));
    for _ in 0..9 {
        let panicked = std::panic::catch_unwind(|| panics().map_err(|error: io::Error| error.kind()));
        assert!(panicked.is_err());
    }
    assert_eq!(payload(1, 2), [1, 1][..]);
    assert_eq!(buffers(), 2);
}
