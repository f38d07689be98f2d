//! Datagrams that nobody can forge without the key, or use twice.

use std::{num::NonZeroUsize, time::Duration};

use proptest::prelude::*;
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{Checker, DiscoveryKey, Sealer, Stamp, Tag, Verdict};

const HIP: [u8; 4] = [192, 168, 0, 11];
const INCARNATION: Incarnation = Incarnation(0x0123_4567_89ab_cdef);
/// The duration of a handshake without delays.
const AT_ONCE: Duration = Duration::ZERO;

fn key(first: u8) -> DiscoveryKey {
    let digits: String = (0..32).map(|byte: u8| format!("{:02x}", byte.wrapping_add(first))).collect();
    DiscoveryKey::read(digits.as_bytes()).unwrap()
}

fn sealer() -> Sealer {
    Sealer::new(&key(0), "walker", HIP.into(), INCARNATION)
}

fn checker(nodes_max: usize) -> Checker {
    Checker::new(&key(0), "walker", NonZeroUsize::new(nodes_max).unwrap())
}

/// A checker that has confirmed the hip's incarnation.
fn confirmed_checker() -> Checker {
    let mut checker = checker(4);
    checker.confirm(Time::ZERO, AT_ONCE, Stamp { node: HIP.into(), incarnation: INCARNATION, number: 0 });
    checker
}

fn at(millis: u64) -> Time {
    Time::from_nanos(millis * 1_000_000)
}

/// Computed by Python's `hmac` from the module's documentation: a node in another language gets the same
/// value.
#[test]
fn tag_matches_the_documentation() {
    let (stamp, tag) = sealer().seal(b"who is there?");
    assert_eq!(stamp.number, 1);
    assert_eq!(u128::from_be_bytes(tag.0), 0x52db_9780_e082_92dd_1ea6_5cbe_dc89_f1e7);
}

#[test]
fn datagram_is_fresh_only_once() {
    let (mut sealer, mut checker) = (sealer(), confirmed_checker());
    let (stamp, tag) = sealer.seal(b"here");
    assert_eq!(checker.check(at(1), stamp, tag, b"here"), Verdict::Fresh);
    assert_eq!(checker.check(at(2), stamp, tag, b"here"), Verdict::Replayed);
    let (stamp, tag) = sealer.seal(b"here");
    assert_eq!(checker.check(at(3), stamp, tag, b"here"), Verdict::Fresh);
}

/// A node uses one sequence of numbers for all destinations. Queries and answers to other members must not
/// turn a delayed datagram into a replay, when another route or a retransmitting radio holds it up for a
/// moment.
#[test]
fn late_datagram_is_fresh_after_hundreds_of_others() {
    let (mut sealer, mut checker) = (sealer(), confirmed_checker());
    let late = sealer.seal(b"by radio");
    let to_others = 2 * 500;
    let newer = (0..to_others).map(|_| sealer.seal(b"by wire")).last().unwrap();
    assert_eq!(checker.check(at(1), newer.0, newer.1, b"by wire"), Verdict::Fresh);
    assert_eq!(checker.check(at(2), late.0, late.1, b"by radio"), Verdict::Fresh);
    assert_eq!(checker.check(at(3), late.0, late.1, b"by radio"), Verdict::Replayed, "and once");
}

#[test]
fn other_project_or_key_is_a_forgery() {
    for mut other in [
        Sealer::new(&key(1), "walker", HIP.into(), INCARNATION),
        Sealer::new(&key(0), "other", HIP.into(), INCARNATION),
        Sealer::new(&key(0), "walkerx", HIP.into(), INCARNATION),
    ] {
        let (stamp, tag) = other.seal(b"here");
        assert_eq!(confirmed_checker().check(at(1), stamp, tag, b"here"), Verdict::Forged);
    }
}

#[test]
fn unconfirmed_incarnation_stays_a_hint_when_repeated() {
    let (mut sealer, mut checker) = (sealer(), checker(4));
    let (stamp, tag) = sealer.seal(b"here");
    for _ in 0..3 {
        assert_eq!(checker.check(at(1), stamp, tag, b"here"), Verdict::OtherLife);
    }
    assert!(checker.is_empty(), "who is not confirmed takes no memory");
}

#[test]
fn smaller_incarnation_takes_over_once_confirmed() {
    // Given: a robot with a clock that went back to 1970 while it was off
    let (mut before, mut checker) = (sealer(), confirmed_checker());
    let mut after = Sealer::new(&key(0), "walker", HIP.into(), Incarnation(7));
    let (old, old_tag) = before.seal(b"here");
    let (new, new_tag) = after.seal(b"here");
    assert_eq!(checker.check(at(1), new, new_tag, b"here"), Verdict::OtherLife);
    // When
    checker.confirm(at(2), AT_ONCE, Stamp { number: 0, ..new });
    // Then: it is valid, and the recorded datagrams of its former incarnation are not
    assert_eq!(checker.check(at(3), new, new_tag, b"here"), Verdict::Fresh);
    assert_eq!(checker.check(at(4), old, old_tag, b"here"), Verdict::OtherLife);
}

#[test]
fn recorded_datagrams_are_void_after_handshake() {
    let (mut sealer, mut checker) = (sealer(), checker(4));
    let (recorded, tag) = sealer.seal(b"here");
    checker.confirm(at(1), AT_ONCE, Stamp { number: sealer.made(), ..recorded });
    assert_eq!(checker.check(at(2), recorded, tag, b"here"), Verdict::Replayed);
    let (stamp, tag) = sealer.seal(b"here");
    assert_eq!(checker.check(at(3), stamp, tag, b"here"), Verdict::Fresh);
}

#[test]
fn repeated_confirmation_keeps_the_window() {
    let (mut sealer, mut checker) = (sealer(), confirmed_checker());
    let (stamp, tag) = sealer.seal(b"here");
    assert_eq!(checker.check(at(1), stamp, tag, b"here"), Verdict::Fresh);
    checker.confirm(at(2), AT_ONCE, Stamp { number: 0, ..stamp });
    assert_eq!(checker.check(at(3), stamp, tag, b"here"), Verdict::Replayed);
}

#[test]
fn forged_number_blocks_node_until_next_handshake() {
    for forged in [u64::MAX, 2_000] {
        // Given: an attacker with the project's key has used up the numbers of another node
        let (mut sealer, mut checker) = (sealer(), confirmed_checker());
        let (recorded, recorded_tag) = sealer.seal(b"here");
        assert_eq!(checker.check(at(1), recorded, recorded_tag, b"here"), Verdict::Fresh);
        let stamp = Stamp { number: forged, ..recorded };
        let tag = Tag::of(&key(0).of_tags("walker"), stamp, b"gone");
        assert_eq!(checker.check(at(2), stamp, tag, b"gone"), Verdict::Fresh);
        let (stamp, tag) = sealer.seal(b"here");
        assert_eq!(checker.check(at(3), stamp, tag, b"here"), Verdict::Replayed);
        // When: the node states its number of datagrams in a handshake
        checker.confirm(at(4), AT_ONCE, Stamp { number: sealer.made(), ..stamp });
        // Then
        let (stamp, tag) = sealer.seal(b"here");
        assert_eq!(checker.check(at(5), stamp, tag, b"here"), Verdict::Fresh);
        assert_eq!(checker.check(at(6), recorded, recorded_tag, b"here"), Verdict::Replayed);
    }
}

// spec: NDL-1.3
#[test]
fn delayed_handshake_allows_no_replay() {
    // Given: a life states its number of datagrams and then makes 3,000 a second; the statement takes two
    // seconds to arrive
    let (mut sealer, mut checker) = (sealer(), confirmed_checker());
    let made = sealer.made();
    let sent: Vec<_> = (0..6_000).map(|_| sealer.seal(b"here")).collect();
    for (stamp, tag) in sent.iter().copied() {
        assert_eq!(checker.check(at(1_000), stamp, tag, b"here"), Verdict::Fresh);
    }
    // When
    let reported = Stamp { node: HIP.into(), incarnation: INCARNATION, number: made };
    checker.confirm(at(2_000), Duration::from_secs(2), reported);
    // Then
    for (stamp, tag) in sent {
        assert_eq!(checker.check(at(2_001), stamp, tag, b"here"), Verdict::Replayed, "{stamp:?}");
    }
    let (stamp, tag) = sealer.seal(b"here");
    assert_eq!(checker.check(at(2_002), stamp, tag, b"here"), Verdict::Fresh);
}

// spec: NDL-1.3
#[test]
fn handshake_clears_number_impossible_meanwhile() {
    // 10 ms are as many microseconds as 10,000 numbers.
    for (forged, verdict) in [(20_000, Verdict::Fresh), (9_000, Verdict::Replayed)] {
        let (mut sealer, mut checker) = (sealer(), confirmed_checker());
        let stamp = Stamp { node: HIP.into(), incarnation: INCARNATION, number: forged };
        let tag = Tag::of(&key(0).of_tags("walker"), stamp, b"gone");
        assert_eq!(checker.check(at(1), stamp, tag, b"gone"), Verdict::Fresh);
        checker.confirm(at(20), Duration::from_millis(10), Stamp { number: sealer.made(), ..stamp });
        let (stamp, tag) = sealer.seal(b"here");
        assert_eq!(checker.check(at(21), stamp, tag, b"here"), verdict, "{forged}");
    }
}

#[test]
fn longest_silent_node_is_evicted() {
    let mut checker = checker(2);
    let node = |last: u8| NodeAddress::from([10, 0, 0, last]);
    let reported = |last| Stamp { node: node(last), incarnation: INCARNATION, number: 0 };
    let mut sealers = [1, 2, 3].map(|last| Sealer::new(&key(0), "walker", node(last), INCARNATION));
    checker.confirm(at(1), AT_ONCE, reported(1));
    checker.confirm(at(2), AT_ONCE, reported(2));
    let (stamp, tag) = sealers[0].seal(b"1");
    assert_eq!(checker.check(at(3), stamp, tag, b"1"), Verdict::Fresh);
    // When: a third one comes
    checker.confirm(at(4), AT_ONCE, reported(3));
    // Then: the second, which was silent, is forgotten
    assert_eq!(checker.len(), 2);
    let verdicts = sealers.each_mut().map(|sealer| {
        let (stamp, tag) = sealer.seal(b"2");
        checker.check(at(5), stamp, tag, b"2")
    });
    assert_eq!(verdicts, [Verdict::Fresh, Verdict::OtherLife, Verdict::Fresh]);
}

#[test]
fn key_round_trips_and_is_never_displayed() {
    let key = DiscoveryKey::generate().unwrap();
    let read = DiscoveryKey::read(key.text().as_bytes()).unwrap();
    assert_eq!(*read.text(), *key.text());
    assert_ne!(*DiscoveryKey::generate().unwrap().text(), *key.text());
    assert_eq!(format!("{key:?}"), "DiscoveryKey(..)");
    for wrong in
        ["", "00", &"0".repeat(63), &"0".repeat(65), &"g".repeat(64), &format!("+{}", "0".repeat(63))]
    {
        assert!(DiscoveryKey::read(wrong.as_bytes()).is_none(), "{wrong}");
    }
}

/// All bytes on the wire, in one piece.
fn wire(stamp: Stamp, tag: Tag, datagram: &[u8]) -> Vec<u8> {
    let mut bytes = stamp.node.bits().to_le_bytes().to_vec();
    bytes.extend(stamp.incarnation.0.to_le_bytes());
    bytes.extend(stamp.number.to_le_bytes());
    bytes.extend(tag.0);
    bytes.extend(datagram);
    bytes
}

fn from_wire(bytes: &[u8]) -> (Stamp, Tag, &[u8]) {
    let (node, rest) = bytes.split_first_chunk().unwrap();
    let (incarnation, rest) = rest.split_first_chunk().unwrap();
    let (number, rest) = rest.split_first_chunk().unwrap();
    let (tag, datagram) = rest.split_first_chunk().unwrap();
    let stamp = Stamp {
        node: NodeAddress::new(u32::from_le_bytes(*node)),
        incarnation: Incarnation(u64::from_le_bytes(*incarnation)),
        number: u64::from_le_bytes(*number),
    };
    (stamp, Tag(*tag), datagram)
}

proptest! {
    #[test]
    fn flipped_bit_is_a_forgery(datagram in prop::collection::vec(any::<u8>(), 0..600), place: prop::sample::Index) {
        let (stamp, tag) = sealer().seal(&datagram);
        let mut bytes = wire(stamp, tag, &datagram);
        let bit = place.index(bytes.len() * 8);
        bytes[bit / 8] ^= 1 << (bit % 8);
        let (stamp, tag, datagram) = from_wire(&bytes);
        prop_assert_eq!(confirmed_checker().check(at(1), stamp, tag, datagram), Verdict::Forged);
    }

    #[test]
    fn cut_or_extended_datagram_is_a_forgery(datagram in prop::collection::vec(any::<u8>(), 1..200), place: prop::sample::Index) {
        let (stamp, tag) = sealer().seal(&datagram);
        let cut = &datagram[..place.index(datagram.len())];
        let longer = [&datagram[..], &[0]].concat();
        for other in [cut, &longer] {
            prop_assert_eq!(confirmed_checker().check(at(1), stamp, tag, other), Verdict::Forged);
        }
    }

    /// Datagrams that overtake each other by less than the window, some twice: each counts, and once.
    #[test]
    fn reordered_is_fresh_and_repeated_is_replayed(
        order in Just((0..64_usize).collect::<Vec<_>>()).prop_shuffle(),
        again in prop::collection::vec(0..64_usize, 0..64),
    ) {
        let (mut sealer, mut checker) = (sealer(), confirmed_checker());
        let sent: Vec<_> = (0..64_u8).map(|byte| (sealer.seal(&[byte]), [byte])).collect();
        for at_sent in order {
            let ((stamp, tag), datagram) = sent[at_sent];
            prop_assert_eq!(checker.check(at(1), stamp, tag, &datagram), Verdict::Fresh);
        }
        for at_sent in again {
            let ((stamp, tag), datagram) = sent[at_sent];
            prop_assert_eq!(checker.check(at(2), stamp, tag, &datagram), Verdict::Replayed);
        }
    }
}
