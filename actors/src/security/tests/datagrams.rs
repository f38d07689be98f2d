//! What nobody without the key can make, and nobody can use twice.

use std::{num::NonZeroUsize, time::Duration};

use proptest::prelude::*;
use sinew_runtime::{
    tid::{Incarnation, NodeAddress},
    time::Time,
};

use super::{Checker, DiscoveryKey, Sealer, Stamp, Tag, Verdict};

const HIP: [u8; 4] = [192, 168, 0, 11];
const LIFE: Incarnation = Incarnation(0x0123_4567_89ab_cdef);
/// How long a handshake lasts that nobody holds up.
const AT_ONCE: Duration = Duration::ZERO;

fn key(first: u8) -> DiscoveryKey {
    let digits: String = (0..32).map(|byte: u8| format!("{:02x}", byte.wrapping_add(first))).collect();
    DiscoveryKey::read(digits.as_bytes()).unwrap()
}

fn sealer() -> Sealer {
    Sealer::new(&key(0), "walker", HIP.into(), LIFE)
}

fn checker(nodes_max: usize) -> Checker {
    Checker::new(&key(0), "walker", NonZeroUsize::new(nodes_max).unwrap())
}

/// One that knows the hip's life.
fn acquainted() -> Checker {
    let mut checker = checker(4);
    checker.confirm(Time::ZERO, AT_ONCE, Stamp { node: HIP.into(), incarnation: LIFE, number: 0 });
    checker
}

fn at(millis: u64) -> Time {
    Time::from_nanos(millis * 1_000_000)
}

/// Made by Python's `hmac` from what the module says: whoever writes a node in another language gets the same.
#[test]
fn the_tag_is_what_the_documentation_says() {
    let (stamp, tag) = sealer().seal(b"who is there?");
    assert_eq!(stamp.number, 1);
    assert_eq!(u128::from_be_bytes(tag.0), 0x52db_9780_e082_92dd_1ea6_5cbe_dc89_f1e7);
}

#[test]
fn a_datagram_counts_once() {
    let (mut sealer, mut checker) = (sealer(), acquainted());
    let (stamp, tag) = sealer.seal(b"here");
    assert_eq!(checker.check(at(1), stamp, tag, b"here"), Verdict::Fresh);
    assert_eq!(checker.check(at(2), stamp, tag, b"here"), Verdict::Replayed);
    let (stamp, tag) = sealer.seal(b"here");
    assert_eq!(checker.check(at(3), stamp, tag, b"here"), Verdict::Fresh);
}

/// One row of numbers is for everybody to whom a node speaks: what it asks and answers its other members meanwhile makes no datagram a
/// replay that another route, or a radio that sends again, holds up for a moment.
#[test]
fn an_honest_datagram_that_comes_late_counts_though_its_maker_spoke_to_hundreds_meanwhile() {
    let (mut sealer, mut checker) = (sealer(), acquainted());
    let late = sealer.seal(b"by radio");
    let to_others = 2 * 500;
    let newer = (0..to_others).map(|_| sealer.seal(b"by wire")).last().unwrap();
    assert_eq!(checker.check(at(1), newer.0, newer.1, b"by wire"), Verdict::Fresh);
    assert_eq!(checker.check(at(2), late.0, late.1, b"by radio"), Verdict::Fresh);
    assert_eq!(checker.check(at(3), late.0, late.1, b"by radio"), Verdict::Replayed, "and once");
}

#[test]
fn nodes_of_another_project_or_key_are_forgers() {
    for mut other in [
        Sealer::new(&key(1), "walker", HIP.into(), LIFE),
        Sealer::new(&key(0), "other", HIP.into(), LIFE),
        Sealer::new(&key(0), "walkerx", HIP.into(), LIFE),
    ] {
        let (stamp, tag) = other.seal(b"here");
        assert_eq!(acquainted().check(at(1), stamp, tag, b"here"), Verdict::Forged);
    }
}

#[test]
fn a_life_that_did_not_prove_itself_is_a_hint_however_often_it_is_played() {
    let (mut sealer, mut checker) = (sealer(), checker(4));
    let (stamp, tag) = sealer.seal(b"here");
    for _ in 0..3 {
        assert_eq!(checker.check(at(1), stamp, tag, b"here"), Verdict::OtherLife);
    }
    assert!(checker.is_empty(), "who is not confirmed takes no memory");
}

#[test]
fn a_life_with_a_smaller_number_takes_over_when_it_has_proven_itself() {
    // Given: a robot whose clock went back to 1970 while it was off
    let (mut before, mut checker) = (sealer(), acquainted());
    let mut after = Sealer::new(&key(0), "walker", HIP.into(), Incarnation(7));
    let (old, old_tag) = before.seal(b"here");
    let (new, new_tag) = after.seal(b"here");
    assert_eq!(checker.check(at(1), new, new_tag, b"here"), Verdict::OtherLife);
    // When
    checker.confirm(at(2), AT_ONCE, Stamp { number: 0, ..new });
    // Then: it counts, and what was recorded of its former life does not
    assert_eq!(checker.check(at(3), new, new_tag, b"here"), Verdict::Fresh);
    assert_eq!(checker.check(at(4), old, old_tag, b"here"), Verdict::OtherLife);
}

#[test]
fn what_was_recorded_before_the_handshake_does_not_count_after_it() {
    let (mut sealer, mut checker) = (sealer(), checker(4));
    let (recorded, tag) = sealer.seal(b"here");
    checker.confirm(at(1), AT_ONCE, Stamp { number: sealer.made(), ..recorded });
    assert_eq!(checker.check(at(2), recorded, tag, b"here"), Verdict::Replayed);
    let (stamp, tag) = sealer.seal(b"here");
    assert_eq!(checker.check(at(3), stamp, tag, b"here"), Verdict::Fresh);
}

#[test]
fn to_confirm_a_life_again_forgets_nothing_of_it() {
    let (mut sealer, mut checker) = (sealer(), acquainted());
    let (stamp, tag) = sealer.seal(b"here");
    assert_eq!(checker.check(at(1), stamp, tag, b"here"), Verdict::Fresh);
    checker.confirm(at(2), AT_ONCE, Stamp { number: 0, ..stamp });
    assert_eq!(checker.check(at(3), stamp, tag, b"here"), Verdict::Replayed);
}

#[test]
fn a_number_that_its_node_cannot_have_made_bars_it_until_the_next_handshake_and_no_longer() {
    for forged in [u64::MAX, 2_000] {
        // Given: who has the project's key used up the numbers of another node
        let (mut sealer, mut checker) = (sealer(), acquainted());
        let (recorded, recorded_tag) = sealer.seal(b"here");
        assert_eq!(checker.check(at(1), recorded, recorded_tag, b"here"), Verdict::Fresh);
        let stamp = Stamp { number: forged, ..recorded };
        let tag = Tag::of(&key(0).of_tags("walker"), stamp, b"gone");
        assert_eq!(checker.check(at(2), stamp, tag, b"gone"), Verdict::Fresh);
        let (stamp, tag) = sealer.seal(b"here");
        assert_eq!(checker.check(at(3), stamp, tag, b"here"), Verdict::Replayed);
        // When: it says in a handshake how many it has made
        checker.confirm(at(4), AT_ONCE, Stamp { number: sealer.made(), ..stamp });
        // Then
        let (stamp, tag) = sealer.seal(b"here");
        assert_eq!(checker.check(at(5), stamp, tag, b"here"), Verdict::Fresh);
        assert_eq!(checker.check(at(6), recorded, recorded_tag, b"here"), Verdict::Replayed);
    }
}

// spec: NDL-1.3
#[test]
fn a_handshake_that_somebody_holds_up_lets_nothing_count_again() {
    // Given: a life says how many datagrams it has made, goes on to make 3,000 a second, and its word is under way for two seconds
    let (mut sealer, mut checker) = (sealer(), acquainted());
    let made = sealer.made();
    let sent: Vec<_> = (0..6_000).map(|_| sealer.seal(b"here")).collect();
    for (stamp, tag) in sent.iter().copied() {
        assert_eq!(checker.check(at(1_000), stamp, tag, b"here"), Verdict::Fresh);
    }
    // When
    let said = Stamp { node: HIP.into(), incarnation: LIFE, number: made };
    checker.confirm(at(2_000), Duration::from_secs(2), said);
    // Then
    for (stamp, tag) in sent {
        assert_eq!(checker.check(at(2_001), stamp, tag, b"here"), Verdict::Replayed, "{stamp:?}");
    }
    let (stamp, tag) = sealer.seal(b"here");
    assert_eq!(checker.check(at(2_002), stamp, tag, b"here"), Verdict::Fresh);
}

// spec: NDL-1.3
#[test]
fn a_number_that_its_node_cannot_have_made_while_the_handshake_lasted_bars_it_no_longer() {
    // 10 ms are as many microseconds as 10,000 numbers.
    for (forged, verdict) in [(20_000, Verdict::Fresh), (9_000, Verdict::Replayed)] {
        let (mut sealer, mut checker) = (sealer(), acquainted());
        let stamp = Stamp { node: HIP.into(), incarnation: LIFE, number: forged };
        let tag = Tag::of(&key(0).of_tags("walker"), stamp, b"gone");
        assert_eq!(checker.check(at(1), stamp, tag, b"gone"), Verdict::Fresh);
        checker.confirm(at(20), Duration::from_millis(10), Stamp { number: sealer.made(), ..stamp });
        let (stamp, tag) = sealer.seal(b"here");
        assert_eq!(checker.check(at(21), stamp, tag, b"here"), verdict, "{forged}");
    }
}

#[test]
fn memory_is_bounded_and_who_was_silent_longest_is_forgotten() {
    let mut checker = checker(2);
    let node = |last: u8| NodeAddress::from([10, 0, 0, last]);
    let said = |last| Stamp { node: node(last), incarnation: LIFE, number: 0 };
    let mut sealers = [1, 2, 3].map(|last| Sealer::new(&key(0), "walker", node(last), LIFE));
    checker.confirm(at(1), AT_ONCE, said(1));
    checker.confirm(at(2), AT_ONCE, said(2));
    let (stamp, tag) = sealers[0].seal(b"1");
    assert_eq!(checker.check(at(3), stamp, tag, b"1"), Verdict::Fresh);
    // When: a third one comes
    checker.confirm(at(4), AT_ONCE, said(3));
    // Then: the second, which was silent, is forgotten
    assert_eq!(checker.len(), 2);
    let verdicts = sealers.each_mut().map(|sealer| {
        let (stamp, tag) = sealer.seal(b"2");
        checker.check(at(5), stamp, tag, b"2")
    });
    assert_eq!(verdicts, [Verdict::Fresh, Verdict::OtherLife, Verdict::Fresh]);
}

#[test]
fn a_key_is_read_as_it_is_written_and_shown_to_nobody() {
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

/// Everything that is on the wire, in one piece.
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
    fn any_flipped_bit_is_a_forgery(datagram in prop::collection::vec(any::<u8>(), 0..600), place: prop::sample::Index) {
        let (stamp, tag) = sealer().seal(&datagram);
        let mut bytes = wire(stamp, tag, &datagram);
        let bit = place.index(bytes.len() * 8);
        bytes[bit / 8] ^= 1 << (bit % 8);
        let (stamp, tag, datagram) = from_wire(&bytes);
        prop_assert_eq!(acquainted().check(at(1), stamp, tag, datagram), Verdict::Forged);
    }

    #[test]
    fn what_is_cut_or_longer_is_a_forgery(datagram in prop::collection::vec(any::<u8>(), 1..200), place: prop::sample::Index) {
        let (stamp, tag) = sealer().seal(&datagram);
        let cut = &datagram[..place.index(datagram.len())];
        let longer = [&datagram[..], &[0]].concat();
        for other in [cut, &longer] {
            prop_assert_eq!(acquainted().check(at(1), stamp, tag, other), Verdict::Forged);
        }
    }

    /// Datagrams that overtake each other by less than the window, some twice: each counts, and once.
    #[test]
    fn what_overtakes_counts_and_what_comes_twice_does_not(
        order in Just((0..64_usize).collect::<Vec<_>>()).prop_shuffle(),
        again in prop::collection::vec(0..64_usize, 0..64),
    ) {
        let (mut sealer, mut checker) = (sealer(), acquainted());
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
