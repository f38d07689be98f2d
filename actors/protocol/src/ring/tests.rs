use proptest::prelude::*;
use sinew_runtime::{tid::Tid, wire::Kind};
use sinew_shm::BellKind;

use super::*;

fn ring() -> (Producer, Consumer) {
    let make = || Region::create(Capacity::MIN, BellKind::Futex).expect("a region");
    let ((left, left_offer), (right, right_offer)) = (make(), make());
    let (producer, _) = left.connect(right_offer, &Terms::default()).expect("an honest offer");
    let (_, consumer) = right.connect(left_offer, &Terms::default()).expect("an honest offer");
    (producer, consumer)
}

fn frame(length: usize) -> Vec<u8> {
    let header = Header::new(Kind::named("test"), Tid::NONE, Tid::BROADCAST);
    [&header.encode_in_memory(length)[..], &vec![7; length]].concat()
}

/// How a frame is cut into records.
#[derive(Clone, Copy, Debug)]
enum Cut {
    Whole,
    At(usize),
    /// The next frame begins in the same record.
    WithNext,
}

fn cut() -> impl Strategy<Value = Cut> {
    prop_oneof![Just(Cut::Whole), (1usize..300).prop_map(Cut::At), Just(Cut::WithNext)]
}

proptest! {
    #[test]
    fn frames_arrive_in_order_however_they_are_cut(
        sent in proptest::collection::vec((0usize..300, cut()), 1..20),
        enough in 1usize..2_000,
    ) {
        let ((mut producer, mut consumer), mut frames) = (ring(), RingFrames::new(300));
        let (mut record, mut read) = (Vec::new(), Vec::new());
        let mut write = |bytes: Vec<u8>| {
            while producer.send(&bytes).is_err() {
                assert_eq!(frames.take(&mut consumer, enough).expect("an honest peer"), Taken::Some);
                while let Some(message) = frames.next_message().expect("no frame is wrong") {
                    read.push(message.payload.len());
                }
            }
        };
        for (length, cut) in &sent {
            record.extend(frame(*length));
            match cut {
                Cut::Whole => write(std::mem::take(&mut record)),
                Cut::At(at) => {
                    let rest = record.split_off((*at).min(record.len() - 1));
                    write(std::mem::replace(&mut record, rest));
                }
                // A longer one has no room in a record.
                Cut::WithNext if record.len() < 1_000 => {}
                Cut::WithNext => write(std::mem::take(&mut record)),
            }
        }
        if !record.is_empty() {
            write(record);
        }
        while frames.take(&mut consumer, enough).expect("an honest peer") == Taken::Some {
            while let Some(message) = frames.next_message().expect("no frame is wrong") {
                read.push(message.payload.len());
            }
        }
        prop_assert_eq!(read, sent.iter().map(|(length, _)| *length).collect::<Vec<_>>());
    }
}

#[test]
fn one_poll_reads_half_of_four_pieces() {
    // given
    let ((mut producer, mut consumer), mut frames) = (ring(), RingFrames::new(100_000));
    let long = frame(50_000);
    let mut left = &long[..];
    // when
    for piece in 1..=4 {
        let written = write(&mut producer, &[IoSlice::new(left)]).expect("there is room");
        assert_eq!(written + MARK_BYTES, Capacity::MIN.bytes() as usize / 4, "piece {piece}");
        left = &left[written..];
    }
    // then
    assert!(matches!(write(&mut producer, &[IoSlice::new(left)]), Err(LoanError::Full { .. })));
    assert_eq!(frames.take(&mut consumer, 1).expect("an honest peer"), Taken::Some);
    let taken = Capacity::MIN.bytes() - producer.unread().expect("an honest peer");
    assert_eq!(taken, Capacity::MIN.bytes() / 2);
}

#[test]
fn repeatedly_withdrawn_frames_bound_each_poll() {
    // Given: a ring full of starts of a long frame, each with the record that withdraws it
    let ((mut producer, mut consumer), mut frames) = (ring(), RingFrames::new(1 << 20));
    let (begins, mut written) = (&frame(1 << 20)[..64], 0);
    while write(&mut producer, &[IoSlice::new(begins)]).is_ok() && withdraw(&mut producer).is_ok() {
        written += 1;
    }
    assert!(written > 20, "{written} starts");
    // When: it is read, for as little as may be
    let (mut polls, mut copied, mut idle) = (0, 0, 0);
    while frames.take(&mut consumer, 1).expect("an honest peer") == Taken::Some {
        assert!(frames.next_message().expect("no frame is wrong").is_none());
        (polls, copied) = (polls + 1, copied + frames.copied());
        assert!(frames.copied() <= RECORDS_PER_POLL * begins.len());
        idle += frames.take_idle();
    }
    // Then: every copied byte, and every record, is accounted for
    assert!(polls * RECORDS_PER_POLL >= 2 * written, "{polls} polls of {written} starts");
    assert!(copied >= written * begins.len());
    assert!(idle >= 2 * written * RECORD_WORK + written * begins.len(), "{idle}");
    assert_eq!(frames.take_idle(), 0);
}

#[test]
fn withdrawn_parts_do_not_extend_a_poll() {
    // Given: starts of frames of half a poll each, all of them withdrawn
    let terms = Terms { capacity_max: Capacity::MAX, ..Terms::default() };
    let make = || Region::create(capacity(2 << 20), BellKind::Futex).expect("a region");
    let ((left, left_offer), (right, right_offer)) = (make(), make());
    let (mut producer, _) = left.connect(right_offer, &terms).expect("an honest offer");
    let (_, mut consumer) = right.connect(left_offer, &terms).expect("an honest offer");
    let begins = &frame(1 << 20)[..ENOUGH_MIN / 2];
    for _ in 0..8 {
        write(&mut producer, &[IoSlice::new(begins)]).expect("there is room");
        withdraw(&mut producer).expect("there is room");
    }
    // When, then
    let mut frames = RingFrames::new(1 << 20);
    for poll in 0..4 {
        assert_eq!(frames.take(&mut consumer, 1).expect("an honest peer"), Taken::Some);
        assert_eq!(frames.copied(), ENOUGH_MIN, "poll {poll}");
    }
}

#[test]
fn consecutive_long_frames_keep_their_lengths() {
    // Given: a writer that is ahead as far as there is room.
    const LENGTH: usize = 1_500_000;
    let ((mut producer, mut consumer), mut frames) = (ring(), RingFrames::new(LENGTH));
    let long = frame(LENGTH);
    let (mut left, mut written, mut received) = (&long[..], 0, Vec::new());
    while received.len() < 4 {
        while let Ok(count) = write(&mut producer, &[IoSlice::new(left)]) {
            left = &left[count..];
            if left.is_empty() {
                written += 1;
                left = if written < 4 { &long } else { break };
            }
        }
        // When: it is read.
        assert_eq!(frames.take(&mut consumer, usize::MAX).expect("an honest peer"), Taken::Some);
        while let Some(message) = frames.next_message().expect("a frame") {
            received.push(message.payload);
        }
    }
    // Then:
    for payload in received {
        let mut memory = payload.try_into_mut().expect("no other holder exists");
        memory.clear();
        assert!(!memory.try_reclaim(2 * LENGTH), "it keeps twice its length");
    }
}

#[test]
fn empty_record_withdraws_only_the_started_frame() {
    let (whole, begun) = (frame(100), frame(1_000));
    for part in [1, 7, 8, HEADER_LEN, HEADER_LEN + 999] {
        // given
        let ((mut producer, mut consumer), mut frames) = (ring(), RingFrames::new(4_096));
        for bytes in [&whole, &whole, &begun[..part].to_vec()] {
            producer.send(bytes).expect("there is room");
        }
        // when
        withdraw(&mut producer).expect("there is room");
        withdraw(&mut producer).expect("there is room");
        producer.send(&whole).expect("there is room");
        // then
        assert_eq!(frames.take(&mut consumer, usize::MAX).expect("an honest peer"), Taken::Some);
        for _ in 0..3 {
            assert_eq!(frames.next_message().expect("a frame").expect("a frame").payload.len(), 100);
        }
        assert!(frames.next_message().expect("nothing wrong").is_none(), "{part} bytes had been written");
    }
}
