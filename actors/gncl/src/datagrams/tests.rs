//! The properties of the two halves, one by one; the simulation checks their combination.

use std::time::Duration;

use proptest::prelude::*;
use sinew_runtime::time::Time;

use super::{
    core::{Core, Order, stamp},
    incoming::Incoming,
    lengths::SHORTEST,
    outgoing::{LIMITS, Limits, Offered, Outgoing},
    packet::{Acknowledgement, DATAGRAM_MAX, RANGES_MAX, Range},
};

const NOW: Time = Time::from_nanos(1_000_000_000);

fn outgoing(datagrams: usize, bytes: usize, flows: usize) -> Outgoing<u32, u32> {
    Outgoing::new(100, Limits { datagrams, bytes, flows })
}

fn acknowledging(numbers: &[u64], taken: u64) -> Acknowledgement {
    let mut ranges = [Range::of(0); RANGES_MAX];
    for (range, number) in ranges.iter_mut().zip(numbers) {
        *range = Range::of(*number);
    }
    Acknowledgement { echo: 0, held_us: 0, taken, ranges, count: numbers.len() }
}

/// Returns the numbers of all values that are sent now.
fn sent(outgoing: &mut Outgoing<u32, u32>, now: Time) -> Vec<u64> {
    std::iter::from_fn(|| outgoing.transmit(now)).map(|(_, number)| number).collect()
}

#[test]
fn values_beyond_the_window_wait_and_are_superseded() {
    let mut outgoing = outgoing(2, 1_000, 8);
    for key in 0..3 {
        outgoing.submit(key, 1, 100, Time::MAX).unwrap();
    }
    assert_eq!(sent(&mut outgoing, NOW), [100, 101]);
    for value in 2..9 {
        outgoing.submit(2, value, 100, Time::MAX).unwrap();
    }
    assert!(sent(&mut outgoing, NOW).is_empty());
    outgoing.acknowledged(&acknowledging(&[100], 1), 500);
    assert_eq!(sent(&mut outgoing, NOW), [109]);
    assert_eq!(outgoing.value(&2), Some(&8));
    let position = outgoing.position();
    assert_eq!((position.superseded(), position.arrived, position.unacknowledged), (7, 1, 2));
}

// spec: DATAGRAM-6
#[test]
fn no_value_is_superseded_while_acknowledgements_fit_the_window() {
    // Given: 64 flows with a value of 170 bytes each millisecond: 192 of them fit in 32 KiB, which is 3 ms.
    let superseded = |late: usize| {
        let mut outgoing = Outgoing::<u32, u32>::new(100, LIMITS);
        let mut sent_batches: Vec<(Time, Vec<u64>)> = Vec::new();
        for millis in 0..100 {
            let now = NOW + Duration::from_millis(millis);
            if let Some((then, numbers)) = sent_batches.len().checked_sub(late).map(|at| &sent_batches[at]) {
                for numbers in numbers.chunks(RANGES_MAX) {
                    let acknowledging = Acknowledgement { echo: stamp(*then), ..acknowledging(numbers, 0) };
                    outgoing.acknowledged(&acknowledging, stamp(now));
                }
            }
            for key in 0..64 {
                outgoing.submit(key, 1, 170, Time::MAX).unwrap();
            }
            let numbers = sent(&mut outgoing, now);
            sent_batches.push((now, numbers));
        }
        outgoing.counts().superseded
    };
    // When, then: only the window makes a value wait.
    assert_eq!(superseded(1), 0);
    assert_eq!(superseded(3), 0);
    assert!(superseded(4) > 0);
}

#[test]
fn bytes_are_bounded_except_for_one_datagram() {
    let mut outgoing = outgoing(9, 1_000, 8);
    outgoing.submit(1, 1, 1_200, Time::MAX).unwrap();
    outgoing.submit(2, 1, 100, Time::MAX).unwrap();
    assert_eq!(sent(&mut outgoing, NOW), [100]);
    assert_eq!(outgoing.in_flight(), (1, 1_200));
    outgoing.acknowledged(&acknowledging(&[100], 1), 500);
    assert_eq!(sent(&mut outgoing, NOW), [101]);
}

#[test]
fn unacknowledged_value_is_repeated_at_doubling_timeouts() {
    let mut outgoing = outgoing(9, 1_000, 8);
    outgoing.submit(1, 1, 100, Time::MAX).unwrap();
    let mut times = Vec::new();
    for millis in 0..200 {
        if !sent(&mut outgoing, NOW + Duration::from_millis(millis)).is_empty() {
            times.push(millis);
        }
    }
    assert_eq!(times, [0, 20, 60, 140]);
    assert_eq!(outgoing.in_flight(), (1, 100), "it has one place however often it was sent");
    outgoing.acknowledged(&acknowledging(&[100], 1), 500);
    assert_eq!((outgoing.next_wake(), outgoing.left(), outgoing.in_flight()), (None, 0, (0, 0)));
}

#[test]
fn superseded_or_expired_values_are_not_repeated() {
    let mut outgoing = outgoing(9, 1_000, 8);
    let second = Duration::from_secs(1);
    outgoing.submit(1, 1, 100, Time::MAX).unwrap();
    outgoing.submit(2, 1, 100, NOW + Duration::from_millis(5)).unwrap();
    assert_eq!(sent(&mut outgoing, NOW), [100, 101]);
    outgoing.submit(1, 2, 100, Time::MAX).unwrap();
    assert_eq!(sent(&mut outgoing, NOW), [102]);
    assert_eq!(sent(&mut outgoing, NOW + second), [102]);
    let position = outgoing.position();
    assert_eq!((position.superseded(), position.expired(), position.unacknowledged), (1, 1, 1));
    // A value that the peer had accepted after all is not superseded.
    outgoing.acknowledged(&acknowledging(&[102], 2), 500);
    assert_eq!((outgoing.position().arrived, outgoing.position().superseded()), (2, 0));
}

#[test]
fn value_by_the_connection_supersedes_the_one_by_datagram() {
    let mut outgoing = outgoing(9, 1_000, 8);
    outgoing.submit(1, 1, 100, Time::MAX).unwrap();
    assert_eq!(sent(&mut outgoing, NOW), [100]);
    outgoing.submit(2, 1, 100, Time::MAX).unwrap();
    assert_eq!((outgoing.start_on_connection(1), outgoing.start_on_connection(2)), (102, 103));
    outgoing.accepted_by_connection(1, 102);
    outgoing.accepted_by_connection(2, 103);
    assert!(sent(&mut outgoing, NOW + Duration::from_secs(1)).is_empty());
    assert_eq!((outgoing.left(), outgoing.position().superseded()), (0, 2));
}

#[test]
fn last_accepted_value_stays_until_superseded_by_connection() {
    let mut outgoing = outgoing(9, 1_000, 8);
    outgoing.submit(1, 1, 100, Time::MAX).unwrap();
    assert_eq!(sent(&mut outgoing, NOW), [100]);
    outgoing.start_on_connection(1);
    outgoing.rejected_by_connection(1);
    assert_eq!((outgoing.left(), sent(&mut outgoing, NOW + Duration::from_secs(1))), (1, vec![100]));
}

/// Returns the values offered to the connection at `now`, as long as it has `room`.
fn offered_to_connection(outgoing: &mut Outgoing<u32, u32>, now: Time, mut room: usize) -> Vec<(u64, u32)> {
    let mut taken = Vec::new();
    outgoing.offer_to_connection(now, |number, value| {
        if room == 0 {
            return Offered::Full(value);
        }
        room -= 1;
        taken.push((number, value));
        Offered::Taken
    });
    taken
}

#[test]
fn value_without_room_in_the_connection_is_retried() {
    let mut outgoing = outgoing(1, 1_000, 8);
    for key in 1..=3 {
        outgoing.submit(key, key, 100, Time::MAX).unwrap();
    }
    assert_eq!(sent(&mut outgoing, NOW), [100], "the others wait");
    outgoing.assign_to_connection();
    assert_eq!(offered_to_connection(&mut outgoing, NOW, 1), [(100, 1)]);
    assert_eq!((outgoing.left(), outgoing.position().waiting), (2, 2));
    let again = outgoing.next_wake().unwrap();
    assert!(again > NOW);
    assert_eq!(offered_to_connection(&mut outgoing, NOW, 9), [], "it is not due");
    outgoing.submit(2, 7, 100, Time::MAX).unwrap();
    assert_eq!(offered_to_connection(&mut outgoing, again, 9), [(102, 3)]);
    assert_eq!((outgoing.left(), outgoing.next_wake(), outgoing.counts().superseded), (1, None, 1));
}

#[test]
fn value_for_the_connection_never_follows_a_newer_one() {
    let mut outgoing = outgoing(9, 1_000, 8);
    outgoing.submit(1, 1, 100, Time::MAX).unwrap();
    let newer = outgoing.start_on_connection(1);
    outgoing.assign_to_connection();
    assert_eq!(offered_to_connection(&mut outgoing, NOW, 9), []);
    outgoing.accepted_by_connection(1, newer);
    let again = outgoing.next_wake().unwrap();
    assert_eq!((offered_to_connection(&mut outgoing, again, 9), outgoing.left()), (vec![], 0));
    outgoing.submit(1, 2, 100, Time::MAX).unwrap();
    outgoing.start_on_connection(1);
    outgoing.assign_to_connection();
    outgoing.rejected_by_connection(1);
    assert_eq!(offered_to_connection(&mut outgoing, again, 9), [(102, 2)]);
}

#[test]
fn sent_value_refused_by_the_connection_is_unknown() {
    let mut outgoing = outgoing(1, 1_000, 8);
    outgoing.submit(1, 1, 100, Time::MAX).unwrap();
    outgoing.submit(2, 1, 100, Time::MAX).unwrap();
    assert_eq!(sent(&mut outgoing, NOW), [100], "the other one waits");
    outgoing.assign_to_connection();
    outgoing.offer_to_connection(NOW, |_, _| Offered::Refused);
    let position = outgoing.position();
    assert_eq!((position.unknown(), position.counts.lost, position.superseded()), (1, 1, 0));
    assert_eq!((outgoing.left(), position.taken()), (0, 2));
}

#[test]
fn flow_with_a_value_in_handover_makes_no_room() {
    let mut outgoing = outgoing(9, 1_000, 1);
    outgoing.submit(1, 1, 100, Time::MAX).unwrap();
    assert_eq!(sent(&mut outgoing, NOW), [100]);
    outgoing.acknowledged(&acknowledging(&[100], 1), 500);
    let newer = outgoing.start_on_connection(1);
    assert_eq!(outgoing.submit(2, 7, 100, Time::MAX), Err(7));
    outgoing.accepted_by_connection(1, newer);
    outgoing.submit(2, 7, 100, Time::MAX).unwrap();
}

#[test]
fn last_value_for_a_forgetful_peer_uses_the_connection() {
    let mut outgoing = outgoing(1, 1_000, 8);
    outgoing.submit(1, 1, 100, Time::MAX).unwrap();
    outgoing.submit(2, 1, 100, Time::MAX).unwrap();
    assert_eq!(sent(&mut outgoing, NOW), [100], "the other one waits");
    outgoing.begin_anew();
    assert_eq!(offered_to_connection(&mut outgoing, NOW, 9), [(100, 1), (101, 1)]);
    assert_eq!((outgoing.left(), outgoing.position().unknown()), (0, 1));
}

// spec: DATAGRAM-5
#[test]
fn answer_to_a_former_address_is_ignored() {
    let at = |millis| NOW + Duration::from_millis(millis);
    let mut core = Core::<u32, u32>::new(100);
    let probe = |core: &mut Core<u32, u32>, now| {
        core.tick(now, now);
        assert!(matches!(core.poll(now), Some(Order::Probe(_, DATAGRAM_MAX))));
        assert!(matches!(core.poll(now), Some(Order::Probe(_, SHORTEST))));
    };
    let answered = |core: &mut Core<u32, u32>, now, echo| {
        let acknowledging = Acknowledgement { echo: stamp(echo), ..acknowledging(&[], 0) };
        core.acknowledged(now, &acknowledging)
    };
    core.announced(at(0));
    probe(&mut core, at(1));
    core.announced(at(10));
    probe(&mut core, at(11));
    assert!(!answered(&mut core, at(12), at(1)) && !core.is_open());
    assert!(answered(&mut core, at(13), at(11)) && core.is_open());
    // The clock of stamps wraps in 72 minutes: a late answer is still recognized as one.
    let later = at(100 * 60 * 1_000);
    core.announced(at(20));
    assert!(answered(&mut core, later, at(100 * 60 * 1_000 - 1)));
}

// spec: DATAGRAM-7
#[test]
fn acknowledged_value_proves_its_length_if_sent_once() {
    let mut outgoing = outgoing(9, 1_000, 8);
    outgoing.submit(1, 1, 100, Time::MAX).unwrap();
    assert_eq!(sent(&mut outgoing, NOW), [100]);
    outgoing.record_length(100, 132);
    assert_eq!(outgoing.acknowledged(&acknowledging(&[100], 1), 500), 132);
    outgoing.submit(1, 2, 100, Time::MAX).unwrap();
    for (sent_at, length) in [(NOW, 132), (NOW + Duration::from_secs(1), 112)] {
        assert_eq!(sent(&mut outgoing, sent_at), [101]);
        outgoing.record_length(101, length);
    }
    assert_eq!(outgoing.acknowledged(&acknowledging(&[101], 2), 500), 100, "either one may have come");
}

#[test]
fn full_table_drops_an_idle_flow() {
    let mut outgoing = outgoing(9, 1_000, 2);
    outgoing.submit(1, 1, 100, Time::MAX).unwrap();
    outgoing.submit(2, 1, 100, Time::MAX).unwrap();
    assert_eq!(outgoing.submit(3, 7, 100, Time::MAX), Err(7));
    assert_eq!(sent(&mut outgoing, NOW), [100, 101]);
    assert_eq!(outgoing.submit(3, 7, 100, Time::MAX), Err(7));
    outgoing.acknowledged(&acknowledging(&[100], 1), 500);
    outgoing.submit(3, 7, 100, Time::MAX).unwrap();
    assert_eq!(sent(&mut outgoing, NOW), [102]);
}

#[test]
fn excessive_acknowledgement_counts_only_as_far_as_possible() {
    let mut outgoing = outgoing(9, 1_000, 8);
    outgoing.submit(1, 1, 100, Time::MAX).unwrap();
    sent(&mut outgoing, NOW);
    outgoing.acknowledged(&acknowledging(&[99, 101, u64::MAX], u64::MAX), u32::MAX);
    let position = outgoing.position();
    assert_eq!((position.arrived, position.unacknowledged, position.superseded()), (0, 1, 0));
    outgoing.begin_anew();
    outgoing.acknowledged(&acknowledging(&[], u64::MAX), 1);
    assert_eq!(outgoing.position().arrived, 1);
}

#[test]
fn idle_flow_makes_room_regardless_of_busy_ones() {
    const FLOWS: u32 = 1_000;
    let mut outgoing = outgoing(2_000, 2_000_000, FLOWS as usize);
    for key in 0..FLOWS {
        outgoing.submit(key, 1, 100, Time::MAX).unwrap();
    }
    let numbers = sent(&mut outgoing, NOW);
    assert_eq!(numbers.len(), FLOWS as usize);
    // All but one are in flight.
    outgoing.acknowledged(&acknowledging(&numbers[700..701], 1), 500);
    let refused = (FLOWS..).take_while(|key| outgoing.submit(*key, 1, 100, Time::MAX).is_err()).count();
    assert!(refused < FLOWS as usize, "a place is found, and not by looking at all of them at once");
    assert!(outgoing.value(&700).is_none() && outgoing.value(&701).is_some());
    assert!(outgoing.submit(2 * FLOWS, 1, 100, Time::MAX).is_err(), "there is no further one");
}

#[test]
fn evicted_flow_never_goes_back_in_time() {
    let mut incoming = Incoming::new(3);
    for (key, number) in [(1, 10), (2, 20), (3, 30)] {
        assert!(incoming.on_value(NOW, 0, key, number));
    }
    assert!(incoming.on_value(NOW, 0, 4, 40), "a further flow");
    assert_eq!(incoming.flows(), 3);
    assert!(!incoming.on_value(NOW, 0, 1, 10), "it comes a second time");
    assert!(!incoming.on_value(NOW, 0, 1, 9));
    assert!(incoming.on_value(NOW, 0, 1, 50), "a new value of it");
}

#[test]
fn arrivals_wait_for_a_datagram_that_acknowledges_them() {
    let at = |micros| NOW + Duration::from_micros(micros);
    let mut incoming = Incoming::new(3);
    assert_eq!(incoming.due(), None);
    incoming.on_value(at(0), 7, 1, 1);
    incoming.on_value(at(1_000), 8, 1, 2);
    assert!(!incoming.is_due(at(1_499)) && incoming.is_due(at(1_500)), "the first one has waited");
    let first = incoming.take(at(1_030), 32).unwrap();
    let ranges = [Range { first: 1, more: 1 }];
    assert_eq!((first.echo, first.held_us, first.taken, first.ranges()), (8, 30, 2, &ranges[..]));
    assert_eq!((incoming.due(), incoming.take(at(1_030), 32)), (None, None));
    incoming.on_value(at(2_000), 9, 1, 3);
    assert_eq!(incoming.due(), Some(at(3_500)), "a value carried the last acknowledgement");
}

#[test]
fn many_arrivals_are_acknowledged_at_once() {
    let mut incoming = Incoming::new(3);
    for number in 2..33 {
        incoming.on_value(NOW, 9, 1, number);
    }
    assert!(!incoming.is_due(NOW));
    incoming.on_value(NOW, 9, 1, 33);
    assert!(incoming.is_due(NOW));
    assert_eq!(incoming.take(NOW, 32).unwrap().ranges(), [Range { first: 2, more: 31 }]);
    assert_eq!((incoming.due(), incoming.take(NOW, 32)), (None, None));
}

proptest! {
    #[test]
    fn no_value_is_forwarded_twice_or_out_of_order(
        arrivals in proptest::collection::vec((0..6_u32, 1..60_u64, any::<bool>()), 1..200),
        flows_max in 1..5_usize,
    ) {
        let mut incoming = Incoming::new(flows_max);
        let mut last = std::collections::BTreeMap::new();
        for (key, number, by_datagram) in arrivals {
            // A number belongs to one flow.
            let number = number * 6 + u64::from(key);
            let is_new = if by_datagram {
                incoming.on_value(NOW, 0, key, number)
            } else {
                incoming.on_connection_value(key, number)
            };
            if is_new {
                prop_assert!(last.insert(key, number).is_none_or(|last| last < number));
            }
            prop_assert!(incoming.flows() <= flows_max);
        }
    }

    #[test]
    fn every_message_is_accounted_for_within_the_window(
        steps in proptest::collection::vec((0..13_u8, 0..6_u32, 1..1_200_usize), 1..300),
    ) {
        let mut outgoing = outgoing(8, 4_000, 4);
        let (mut now, mut taken) = (NOW, 0);
        for (step, key, bytes) in steps {
            match step {
                0..=4 => drop(outgoing.submit(key, 0, bytes, now + Duration::from_millis(30))),
                5 => {
                    let number = outgoing.start_on_connection(key);
                    match number % 2 {
                        0 => outgoing.accepted_by_connection(key, number),
                        _ => outgoing.rejected_by_connection(key),
                    }
                }
                6..=7 => now = now + Duration::from_millis(bytes as u64 / 40),
                8..=9 => {
                    taken += 1;
                    let newest = outgoing.next_number();
                    outgoing.acknowledged(&acknowledging(&[newest.saturating_sub(key.into()), newest - 1], taken), key);
                }
                10 => outgoing.assign_to_connection(),
                11 => drop(offered_to_connection(&mut outgoing, now, key as usize)),
                _ => outgoing.begin_anew(),
            }
            sent(&mut outgoing, now);
            let (datagrams, in_flight) = outgoing.in_flight();
            prop_assert!(datagrams <= 8 && (in_flight <= 4_000 || datagrams == 1));
            let position = outgoing.position();
            let ends = position.arrived + position.superseded() + position.expired() + position.unknown();
            let here = position.waiting + position.unacknowledged + position.counts.lost;
            prop_assert_eq!(position.taken(), ends + here, "{:?}", position);
        }
    }
}
