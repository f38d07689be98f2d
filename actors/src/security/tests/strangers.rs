//! Bytes of somebody who is no node: cut anywhere, damaged anywhere, or anything at all. None panics, none gets in, and what is kept of them is
//! bounded.

use proptest::prelude::*;

use super::ground::{Authority, NOW, Wire, at, heard, is_open, written};
use crate::security::{Tls, words};

/// What both ends of a good handshake say, turn by turn: the client's first.
fn turns(hip: &Tls, knee: &Tls) -> Vec<Vec<u8>> {
    let mut wire = Wire::new(hip.client(), knee.server());
    let mut turns = Vec::new();
    while turns.last().is_none_or(|turn: &Vec<u8>| !turn.is_empty()) {
        let said = if turns.len() % 2 == 0 { written(&mut wire.client) } else { written(&mut wire.server) };
        if turns.len() % 2 == 0 {
            heard(&mut wire.server, &said).unwrap();
        } else {
            heard(&mut wire.client, &said).unwrap();
        }
        turns.push(said);
    }
    turns
}

/// Tells the end that is dialled `first`, and after its answer, if it has one, `second`.
fn told(knee: &Tls, hip: &Tls, bytes: &[u8]) -> bool {
    let mut wire = Wire::new(hip.client(), knee.server());
    let result = heard(&mut wire.server, bytes);
    if let Err(error) = &result {
        assert!(!words(error).is_empty());
    }
    assert!(knee.peer(&wire.server, None, at(NOW)).is_err());
    is_open(&wire.server)
}

#[test]
fn a_handshake_that_is_cut_anywhere_lets_nobody_in_and_goes_on_when_the_rest_comes() {
    let walker = Authority::new("walker");
    let (hip, knee) = (walker.tls("hip", 11), walker.tls("knee", 12));
    let length = turns(&hip, &knee)[0].len();
    for cut in 0..length {
        let mut wire = Wire::new(hip.client(), knee.server());
        let hello = written(&mut wire.client);
        let cut = cut.min(hello.len() - 1);
        assert_eq!(heard(&mut wire.server, &hello[..cut]), Ok(()), "at {cut}");
        assert!(
            wire.server.is_handshaking() && !wire.server.wants_write(),
            "nothing is said to half a hello"
        );
        assert!(knee.peer(&wire.server, None, at(NOW)).is_err());
        assert_eq!(heard(&mut wire.server, &hello[cut..]), Ok(()));
        assert_eq!(wire.run(), (Ok(()), Ok(())), "at {cut}");
        assert!(knee.peer(&wire.server, None, at(NOW)).is_ok());
    }
}

#[test]
fn garbage_after_any_part_of_a_handshake_lets_nobody_in() {
    let walker = Authority::new("walker");
    let (hip, knee) = (walker.tls("hip", 11), walker.tls("knee", 12));
    let length = turns(&hip, &knee)[0].len();
    for cut in 0..length {
        for garbage in [[0_u8; 600], [0xff; 600], [0x16; 600]] {
            let mut wire = Wire::new(hip.client(), knee.server());
            let hello = written(&mut wire.client);
            let bytes = [&hello[..cut.min(hello.len())], &garbage].concat();
            let result = heard(&mut wire.server, &bytes);
            assert!(!is_open(&wire.server) && knee.peer(&wire.server, None, at(NOW)).is_err());
            if let Err(error) = result {
                assert!(!words(&error).is_empty(), "at {cut}");
            }
        }
    }
}

/// The last flight of the client, where its certificate and the proof of its key are: each byte damaged once.
#[test]
fn a_damaged_proof_lets_nobody_in() {
    let walker = Authority::new("walker");
    let (hip, knee) = (walker.tls("hip", 11), walker.tls("knee", 12));
    let length = turns(&hip, &knee)[2].len();
    for place in (0..length).step_by(3) {
        let mut wire = Wire::new(hip.client(), knee.server());
        heard(&mut wire.server, &written(&mut wire.client)).unwrap();
        heard(&mut wire.client, &written(&mut wire.server)).unwrap();
        let mut proof = written(&mut wire.client);
        let place = place.min(proof.len() - 1);
        // Not the version in a record's head, which nobody looks at (RFC 8446, 5.1).
        proof[place] ^= 0x10;
        let result = heard(&mut wire.server, &proof);
        let is_in = is_open(&wire.server) && knee.peer(&wire.server, None, at(NOW)).is_ok();
        assert!(result.is_err() || !is_in || is_of_a_head(place, &proof), "byte {place} of {}", proof.len());
    }
}

/// Whether byte `place` is the version in the head of a record.
fn is_of_a_head(place: usize, records: &[u8]) -> bool {
    let mut start = 0;
    while let Some([_, _, _, high, low]) = records.get(start..start + 5) {
        if place == start + 1 || place == start + 2 {
            return true;
        }
        start += 5 + usize::from(u16::from_be_bytes([*high, *low]));
    }
    false
}

#[test]
fn a_node_without_security_is_told_from_one_that_has_it() {
    // Given: the first bytes of an open node's handshake, as of any program that does not speak TLS
    let walker = Authority::new("walker");
    let (hip, knee) = (walker.tls("hip", 11), walker.tls("knee", 12));
    let mut wire = Wire::new(hip.client(), knee.server());
    let error = heard(&mut wire.server, &b"SINW\x01\x00\x00\x00hello from an open node"[..]).unwrap_err();
    let said = words(&error);
    assert!(said.contains("does not speak TLS") && said.contains("without [security]"), "{said}");
}

#[test]
fn who_says_ever_more_and_nothing_is_not_kept() {
    // Given: a client whose hello claims to be as long as one may be, and never ends
    let walker = Authority::new("walker");
    let (hip, knee) = (walker.tls("hip", 11), walker.tls("knee", 12));
    let mut wire = Wire::new(hip.client(), knee.server());
    // A handshake record of 16 KiB; its message says that it has 16 MiB.
    let mut record = vec![0x16, 3, 1, 0x40, 0];
    record.extend([1, 0xff, 0xff, 0xff]);
    record.resize(5 + 0x4000, 0);
    let mut taken = 0;
    for _ in 0..100 {
        taken += record.len();
        if heard(&mut wire.server, &record).is_err() {
            break;
        }
    }
    assert!(taken <= 128 << 10, "it was listened to for {taken} bytes");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

    #[test]
    fn any_bytes_are_refused_or_waited_with(bytes in prop::collection::vec(any::<u8>(), 0..2_000)) {
        let walker = Authority::new("walker");
        let (hip, knee) = (walker.tls("hip", 11), walker.tls("knee", 12));
        prop_assert!(!told(&knee, &hip, &bytes));
        let mut client = Wire::new(hip.client(), knee.server()).client;
        let _ = heard(&mut client, &bytes);
        prop_assert!(!is_open(&client));
    }

    #[test]
    fn any_bytes_are_a_certificate_or_not(bytes in prop::collection::vec(any::<u8>(), 0..600), place: prop::sample::Index) {
        let _ = crate::security::Certificate::read(bytes.into());
        let walker = Authority::new("walker");
        let own = walker.credentials("hip", 11);
        let mut damaged = own.certificate.der().to_vec();
        let bit = place.index(damaged.len() * 8);
        damaged[bit / 8] ^= 1 << (bit % 8);
        let proven = own.believed.prove(&damaged.into(), webpki::KeyUsage::client_auth(), at(NOW));
        prop_assert!(proven.is_err(), "no bit of it may be another one");
    }
}
