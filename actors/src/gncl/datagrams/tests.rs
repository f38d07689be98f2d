//! What the two halves promise, one by one; the simulation has what they promise together.

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

fn said(numbers: &[u64], taken: u64) -> Acknowledgement {
    let mut ranges = [Range::of(0); RANGES_MAX];
    for (range, number) in ranges.iter_mut().zip(numbers) {
        *range = Range::of(*number);
    }
    Acknowledgement { echo: 0, held_us: 0, taken, ranges, count: numbers.len() }
}

/// The numbers of all that is sent now.
fn sent(outgoing: &mut Outgoing<u32, u32>, now: Time) -> Vec<u64> {
    std::iter::from_fn(|| outgoing.transmit(now)).map(|(_, number)| number).collect()
}

#[test]
fn what_is_beyond_the_window_waits_and_newer_values_take_its_place() {
    let mut outgoing = outgoing(2, 1_000, 8);
    for key in 0..3 {
        outgoing.submit(key, 1, 100, Time::MAX).unwrap();
    }
    assert_eq!(sent(&mut outgoing, NOW), [100, 101]);
    for value in 2..9 {
        outgoing.submit(2, value, 100, Time::MAX).unwrap();
    }
    assert!(sent(&mut outgoing, NOW).is_empty());
    outgoing.acknowledged(&said(&[100], 1), 500);
    assert_eq!(sent(&mut outgoing, NOW), [109]);
    assert_eq!(outgoing.value(&2), Some(&8));
    let position = outgoing.position();
    assert_eq!((position.superseded(), position.arrived, position.unacknowledged), (7, 1, 2));
}

// spec: DATAGRAM-6
#[test]
fn no_value_is_superseded_before_it_goes_while_acknowledgements_come_within_what_the_window_holds() {
    // Given: 64 flows with a value of 170 bytes each millisecond: 192 of them fit in 32 KiB, which is 3 ms.
    let superseded = |late: usize| {
        let mut outgoing = Outgoing::<u32, u32>::new(100, LIMITS);
        let mut went: Vec<(Time, Vec<u64>)> = Vec::new();
        for millis in 0..100 {
            let now = NOW + Duration::from_millis(millis);
            if let Some((then, numbers)) = went.len().checked_sub(late).map(|at| &went[at]) {
                for numbers in numbers.chunks(RANGES_MAX) {
                    let said = Acknowledgement { echo: stamp(*then), ..said(numbers, 0) };
                    outgoing.acknowledged(&said, stamp(now));
                }
            }
            for key in 0..64 {
                outgoing.submit(key, 1, 170, Time::MAX).unwrap();
            }
            let numbers = sent(&mut outgoing, now);
            went.push((now, numbers));
        }
        outgoing.counts().superseded
    };
    // When, then: it is the window and nothing else that makes a value wait.
    assert_eq!(superseded(1), 0);
    assert_eq!(superseded(3), 0);
    assert!(superseded(4) > 0);
}

#[test]
fn bytes_have_a_bound_too_but_one_datagram_always_goes() {
    let mut outgoing = outgoing(9, 1_000, 8);
    outgoing.submit(1, 1, 1_200, Time::MAX).unwrap();
    outgoing.submit(2, 1, 100, Time::MAX).unwrap();
    assert_eq!(sent(&mut outgoing, NOW), [100]);
    assert_eq!(outgoing.on_the_way(), (1, 1_200));
    outgoing.acknowledged(&said(&[100], 1), 500);
    assert_eq!(sent(&mut outgoing, NOW), [101]);
}

#[test]
fn a_value_is_repeated_after_the_time_out_and_twice_as_long_after_that_until_it_is_acknowledged() {
    let mut outgoing = outgoing(9, 1_000, 8);
    outgoing.submit(1, 1, 100, Time::MAX).unwrap();
    let mut times = Vec::new();
    for millis in 0..200 {
        if !sent(&mut outgoing, NOW + Duration::from_millis(millis)).is_empty() {
            times.push(millis);
        }
    }
    assert_eq!(times, [0, 20, 60, 140]);
    assert_eq!(outgoing.on_the_way(), (1, 100), "it has one place however often it was sent");
    outgoing.acknowledged(&said(&[100], 1), 500);
    assert_eq!((outgoing.next_wake(), outgoing.left(), outgoing.on_the_way()), (None, 0, (0, 0)));
}

#[test]
fn what_was_superseded_or_has_expired_is_not_repeated() {
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
    // What the peer had taken after all is not superseded.
    outgoing.acknowledged(&said(&[102], 2), 500);
    assert_eq!((outgoing.position().arrived, outgoing.position().superseded()), (2, 0));
}

#[test]
fn a_value_that_goes_by_the_connection_supersedes_the_one_that_went_by_datagram() {
    let mut outgoing = outgoing(9, 1_000, 8);
    outgoing.submit(1, 1, 100, Time::MAX).unwrap();
    assert_eq!(sent(&mut outgoing, NOW), [100]);
    outgoing.submit(2, 1, 100, Time::MAX).unwrap();
    assert_eq!((outgoing.given_elsewhere(1), outgoing.given_elsewhere(2)), (102, 103));
    outgoing.taken_elsewhere(1, 102);
    outgoing.taken_elsewhere(2, 103);
    assert!(sent(&mut outgoing, NOW + Duration::from_secs(1)).is_empty());
    assert_eq!((outgoing.left(), outgoing.position().superseded()), (0, 2));
}

#[test]
fn the_last_value_that_was_taken_stays_until_the_connection_has_taken_a_newer_one() {
    let mut outgoing = outgoing(9, 1_000, 8);
    outgoing.submit(1, 1, 100, Time::MAX).unwrap();
    assert_eq!(sent(&mut outgoing, NOW), [100]);
    outgoing.given_elsewhere(1);
    outgoing.refused_elsewhere(1);
    assert_eq!((outgoing.left(), sent(&mut outgoing, NOW + Duration::from_secs(1))), (1, vec![100]));
}

/// What the connection is offered at `now`, as long as it has `room`.
fn handed_over(outgoing: &mut Outgoing<u32, u32>, now: Time, mut room: usize) -> Vec<(u64, u32)> {
    let mut taken = Vec::new();
    outgoing.hand_over(now, |number, value| {
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
fn what_the_connection_has_no_room_for_is_offered_again_unless_something_newer_takes_its_place() {
    let mut outgoing = outgoing(1, 1_000, 8);
    for key in 1..=3 {
        outgoing.submit(key, key, 100, Time::MAX).unwrap();
    }
    assert_eq!(sent(&mut outgoing, NOW), [100], "the others wait");
    outgoing.turn_to_connection();
    assert_eq!(handed_over(&mut outgoing, NOW, 1), [(100, 1)]);
    assert_eq!((outgoing.left(), outgoing.position().waiting), (2, 2));
    let again = outgoing.next_wake().unwrap();
    assert!(again > NOW);
    assert_eq!(handed_over(&mut outgoing, NOW, 9), [], "it is not due");
    outgoing.submit(2, 7, 100, Time::MAX).unwrap();
    assert_eq!(handed_over(&mut outgoing, again, 9), [(102, 3)]);
    assert_eq!((outgoing.left(), outgoing.next_wake(), outgoing.counts().superseded), (1, None, 1));
}

#[test]
fn what_is_for_the_connection_does_not_get_there_behind_a_newer_one_that_is_being_given_to_it() {
    let mut outgoing = outgoing(9, 1_000, 8);
    outgoing.submit(1, 1, 100, Time::MAX).unwrap();
    let newer = outgoing.given_elsewhere(1);
    outgoing.turn_to_connection();
    assert_eq!(handed_over(&mut outgoing, NOW, 9), []);
    outgoing.taken_elsewhere(1, newer);
    let again = outgoing.next_wake().unwrap();
    assert_eq!((handed_over(&mut outgoing, again, 9), outgoing.left()), (vec![], 0));
    outgoing.submit(1, 2, 100, Time::MAX).unwrap();
    outgoing.given_elsewhere(1);
    outgoing.turn_to_connection();
    outgoing.refused_elsewhere(1);
    assert_eq!(handed_over(&mut outgoing, again, 9), [(102, 2)]);
}

#[test]
fn of_what_the_connection_refuses_nobody_knows_whether_it_arrived_if_it_was_sent_and_else_it_is_lost() {
    let mut outgoing = outgoing(1, 1_000, 8);
    outgoing.submit(1, 1, 100, Time::MAX).unwrap();
    outgoing.submit(2, 1, 100, Time::MAX).unwrap();
    assert_eq!(sent(&mut outgoing, NOW), [100], "the other one waits");
    outgoing.turn_to_connection();
    outgoing.hand_over(NOW, |_, _| Offered::Refused);
    let position = outgoing.position();
    assert_eq!((position.unknown(), position.counts.lost, position.superseded()), (1, 1, 0));
    assert_eq!((outgoing.left(), position.taken()), (0, 2));
}

#[test]
fn a_flow_of_which_a_newer_value_is_being_given_to_the_connection_does_not_make_room() {
    let mut outgoing = outgoing(9, 1_000, 1);
    outgoing.submit(1, 1, 100, Time::MAX).unwrap();
    assert_eq!(sent(&mut outgoing, NOW), [100]);
    outgoing.acknowledged(&said(&[100], 1), 500);
    let newer = outgoing.given_elsewhere(1);
    assert_eq!(outgoing.submit(2, 7, 100, Time::MAX), Err(7));
    outgoing.taken_elsewhere(1, newer);
    outgoing.submit(2, 7, 100, Time::MAX).unwrap();
}

#[test]
fn the_last_value_for_a_peer_that_has_forgotten_us_goes_by_the_connection() {
    let mut outgoing = outgoing(1, 1_000, 8);
    outgoing.submit(1, 1, 100, Time::MAX).unwrap();
    outgoing.submit(2, 1, 100, Time::MAX).unwrap();
    assert_eq!(sent(&mut outgoing, NOW), [100], "the other one waits");
    outgoing.begin_anew();
    assert_eq!(handed_over(&mut outgoing, NOW, 9), [(100, 1), (101, 1)]);
    assert_eq!((outgoing.left(), outgoing.position().unknown()), (0, 1));
}

// spec: DATAGRAM-5
#[test]
fn what_answers_a_datagram_to_a_former_address_says_nothing_of_the_present_one() {
    let at = |millis| NOW + Duration::from_millis(millis);
    let mut core = Core::<u32, u32>::new(100);
    let probe = |core: &mut Core<u32, u32>, now| {
        core.tick(now, now);
        assert!(matches!(core.poll(now), Some(Order::Probe(_, DATAGRAM_MAX))));
        assert!(matches!(core.poll(now), Some(Order::Probe(_, SHORTEST))));
    };
    let answered = |core: &mut Core<u32, u32>, now, echo| {
        let said = Acknowledgement { echo: stamp(echo), ..said(&[], 0) };
        core.acknowledged(now, &said)
    };
    core.announced(at(0));
    probe(&mut core, at(1));
    core.announced(at(10));
    probe(&mut core, at(11));
    assert!(!answered(&mut core, at(12), at(1)) && !core.is_open());
    assert!(answered(&mut core, at(13), at(11)) && core.is_open());
    // The clock of stamps turns in 72 minutes: an answer is one however long that takes.
    let later = at(100 * 60 * 1_000);
    core.announced(at(20));
    assert!(answered(&mut core, later, at(100 * 60 * 1_000 - 1)));
}

#[test]
fn a_table_that_is_full_forgets_a_flow_at_rest_and_else_sends_by_the_connection() {
    let mut outgoing = outgoing(9, 1_000, 2);
    outgoing.submit(1, 1, 100, Time::MAX).unwrap();
    outgoing.submit(2, 1, 100, Time::MAX).unwrap();
    assert_eq!(outgoing.submit(3, 7, 100, Time::MAX), Err(7));
    assert_eq!(sent(&mut outgoing, NOW), [100, 101]);
    assert_eq!(outgoing.submit(3, 7, 100, Time::MAX), Err(7));
    outgoing.acknowledged(&said(&[100], 1), 500);
    outgoing.submit(3, 7, 100, Time::MAX).unwrap();
    assert_eq!(sent(&mut outgoing, NOW), [102]);
}

#[test]
fn a_peer_that_says_more_than_can_be_is_believed_as_far_as_it_can_be() {
    let mut outgoing = outgoing(9, 1_000, 8);
    outgoing.submit(1, 1, 100, Time::MAX).unwrap();
    sent(&mut outgoing, NOW);
    outgoing.acknowledged(&said(&[99, 101, u64::MAX], u64::MAX), u32::MAX);
    let position = outgoing.position();
    assert_eq!((position.arrived, position.unacknowledged, position.superseded()), (0, 1, 0));
    outgoing.begin_anew();
    outgoing.acknowledged(&said(&[], u64::MAX), 1);
    assert_eq!(outgoing.position().arrived, 1);
}

#[test]
fn a_flow_that_has_nothing_under_way_makes_room_for_another_however_many_others_have() {
    const FLOWS: u32 = 1_000;
    let mut outgoing = outgoing(2_000, 2_000_000, FLOWS as usize);
    for key in 0..FLOWS {
        outgoing.submit(key, 1, 100, Time::MAX).unwrap();
    }
    let numbers = sent(&mut outgoing, NOW);
    assert_eq!(numbers.len(), FLOWS as usize);
    // All but one are on their way.
    outgoing.acknowledged(&said(&numbers[700..701], 1), 500);
    let refused = (FLOWS..).take_while(|key| outgoing.submit(*key, 1, 100, Time::MAX).is_err()).count();
    assert!(refused < FLOWS as usize, "a place is found, and not by looking at all of them at once");
    assert!(outgoing.value(&700).is_none() && outgoing.value(&701).is_some());
    assert!(outgoing.submit(2 * FLOWS, 1, 100, Time::MAX).is_err(), "there is no further one");
}

#[test]
fn the_flow_that_is_given_up_when_the_table_is_full_never_goes_back_in_time() {
    let mut incoming = Incoming::new(3);
    for (key, number) in [(1, 10), (2, 20), (3, 30)] {
        assert!(incoming.came(NOW, 0, key, number));
    }
    assert!(incoming.came(NOW, 0, 4, 40), "a further flow");
    assert_eq!(incoming.flows(), 3);
    assert!(!incoming.came(NOW, 0, 1, 10), "it comes a second time");
    assert!(!incoming.came(NOW, 0, 1, 9));
    assert!(incoming.came(NOW, 0, 1, 50), "a new value of it");
}

#[test]
fn what_comes_is_acknowledged_at_once_but_no_more_than_once_a_millisecond_unless_it_is_much() {
    let mut incoming = Incoming::new(3);
    assert_eq!(incoming.due(), None);
    incoming.came(NOW, 7, 1, 1);
    assert!(incoming.is_due(NOW));
    let first = incoming.take(NOW + Duration::from_micros(30), 32).unwrap();
    assert_eq!((first.echo, first.held_us, first.taken, first.ranges()), (7, 30, 1, &[Range::of(1)][..]));
    incoming.came(NOW, 8, 1, 2);
    assert!(!incoming.is_due(NOW) && incoming.is_due(NOW + Duration::from_micros(1_030)));
    for number in 3..34 {
        incoming.came(NOW, 9, 1, number);
    }
    assert!(incoming.is_due(NOW));
    assert_eq!(incoming.take(NOW, 32).unwrap().ranges(), [Range { first: 2, more: 31 }]);
    assert_eq!((incoming.due(), incoming.take(NOW, 32)), (None, None));
}

proptest! {
    #[test]
    fn no_order_of_arrivals_is_handed_on_twice_or_out_of_order(
        arrivals in proptest::collection::vec((0..6_u32, 1..60_u64, any::<bool>()), 1..200),
        flows_max in 1..5_usize,
    ) {
        let mut incoming = Incoming::new(flows_max);
        let mut last = std::collections::BTreeMap::new();
        for (key, number, by_datagram) in arrivals {
            // A number belongs to one flow.
            let number = number * 6 + u64::from(key);
            let is_new = if by_datagram {
                incoming.came(NOW, 0, key, number)
            } else {
                incoming.came_by_connection(key, number)
            };
            if is_new {
                prop_assert!(last.insert(key, number).is_none_or(|last| last < number));
            }
            prop_assert!(incoming.flows() <= flows_max);
        }
    }

    #[test]
    fn however_it_is_treated_every_message_is_explained_and_the_window_is_kept(
        steps in proptest::collection::vec((0..13_u8, 0..6_u32, 1..1_200_usize), 1..300),
    ) {
        let mut outgoing = outgoing(8, 4_000, 4);
        let (mut now, mut taken) = (NOW, 0);
        for (step, key, bytes) in steps {
            match step {
                0..=4 => drop(outgoing.submit(key, 0, bytes, now + Duration::from_millis(30))),
                5 => {
                    let number = outgoing.given_elsewhere(key);
                    match number % 2 {
                        0 => outgoing.taken_elsewhere(key, number),
                        _ => outgoing.refused_elsewhere(key),
                    }
                }
                6..=7 => now = now + Duration::from_millis(bytes as u64 / 40),
                8..=9 => {
                    taken += 1;
                    let newest = outgoing.next_number();
                    outgoing.acknowledged(&said(&[newest.saturating_sub(key.into()), newest - 1], taken), key);
                }
                10 => outgoing.turn_to_connection(),
                11 => drop(handed_over(&mut outgoing, now, key as usize)),
                _ => outgoing.begin_anew(),
            }
            sent(&mut outgoing, now);
            let (datagrams, on_the_way) = outgoing.on_the_way();
            prop_assert!(datagrams <= 8 && (on_the_way <= 4_000 || datagrams == 1));
            let position = outgoing.position();
            let ends = position.arrived + position.superseded() + position.expired() + position.unknown();
            let here = position.waiting + position.unacknowledged + position.counts.lost;
            prop_assert_eq!(position.taken(), ends + here, "{:?}", position);
        }
    }
}
