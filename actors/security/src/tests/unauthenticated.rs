//! Bytes of an unauthenticated peer: cut anywhere, damaged anywhere, or arbitrary. They cause no panic and no
//! admission, and the memory kept for them is bounded.

use proptest::prelude::*;

use crate::{
    Tls,
    testing::{Authority, NOW, Wire, at, deliver, is_open, written},
    words,
};

/// The flights of both ends of a successful handshake, the client's first.
fn flights(hip: &Tls, knee: &Tls) -> Vec<Vec<u8>> {
    let mut wire = Wire::new(hip.client(), knee.server());
    let mut flights = Vec::new();
    while flights.last().is_none_or(|flight: &Vec<u8>| !flight.is_empty()) {
        let output =
            if flights.len() % 2 == 0 { written(&mut wire.client) } else { written(&mut wire.server) };
        if flights.len() % 2 == 0 {
            deliver(&mut wire.server, &output).unwrap();
        } else {
            deliver(&mut wire.client, &output).unwrap();
        }
        flights.push(output);
    }
    flights
}

/// Delivers `bytes` to the dialled end. Returns whether its handshake is complete.
fn is_admitted(knee: &Tls, hip: &Tls, bytes: &[u8]) -> bool {
    let mut wire = Wire::new(hip.client(), knee.server());
    let result = deliver(&mut wire.server, bytes);
    if let Err(error) = &result {
        assert!(!words(error).is_empty());
    }
    assert!(knee.peer(&wire.server, None, at(NOW)).is_err());
    is_open(&wire.server)
}

#[test]
fn cut_handshake_admits_no_peer_and_resumes() {
    let walker = Authority::new("walker");
    let (hip, knee) = (walker.tls("hip", 11), walker.tls("knee", 12));
    let length = flights(&hip, &knee)[0].len();
    for cut in 0..length {
        let mut wire = Wire::new(hip.client(), knee.server());
        let hello = written(&mut wire.client);
        let cut = cut.min(hello.len() - 1);
        assert_eq!(deliver(&mut wire.server, &hello[..cut]), Ok(()), "at {cut}");
        assert!(wire.server.is_handshaking() && !wire.server.wants_write(), "half a hello gets no answer");
        assert!(knee.peer(&wire.server, None, at(NOW)).is_err());
        assert_eq!(deliver(&mut wire.server, &hello[cut..]), Ok(()));
        assert_eq!(wire.run(), (Ok(()), Ok(())), "at {cut}");
        assert!(knee.peer(&wire.server, None, at(NOW)).is_ok());
    }
}

#[test]
fn garbage_within_handshake_admits_no_peer() {
    let walker = Authority::new("walker");
    let (hip, knee) = (walker.tls("hip", 11), walker.tls("knee", 12));
    let length = flights(&hip, &knee)[0].len();
    for cut in 0..length {
        for garbage in [[0_u8; 600], [0xff; 600], [0x16; 600]] {
            let mut wire = Wire::new(hip.client(), knee.server());
            let hello = written(&mut wire.client);
            let bytes = [&hello[..cut.min(hello.len())], &garbage].concat();
            let result = deliver(&mut wire.server, &bytes);
            assert!(!is_open(&wire.server) && knee.peer(&wire.server, None, at(NOW)).is_err());
            if let Err(error) = result {
                assert!(!words(&error).is_empty(), "at {cut}");
            }
        }
    }
}

/// The last flight of the client, which contains its certificate and the proof of its key: each byte is
/// damaged once.
#[test]
fn damaged_proof_admits_no_peer() {
    let walker = Authority::new("walker");
    let (hip, knee) = (walker.tls("hip", 11), walker.tls("knee", 12));
    let length = flights(&hip, &knee)[2].len();
    for place in (0..length).step_by(3) {
        let mut wire = Wire::new(hip.client(), knee.server());
        deliver(&mut wire.server, &written(&mut wire.client)).unwrap();
        deliver(&mut wire.client, &written(&mut wire.server)).unwrap();
        let mut proof = written(&mut wire.client);
        let place = place.min(proof.len() - 1);
        // Not the version in a record's head, which is ignored (RFC 8446, 5.1).
        proof[place] ^= 0x10;
        let result = deliver(&mut wire.server, &proof);
        let is_in = is_open(&wire.server) && knee.peer(&wire.server, None, at(NOW)).is_ok();
        assert!(
            result.is_err() || !is_in || is_record_version(place, &proof),
            "byte {place} of {}",
            proof.len()
        );
    }
}

/// Whether byte `place` is the version in the header of a record.
fn is_record_version(place: usize, records: &[u8]) -> bool {
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
fn node_without_security_is_recognized() {
    // Given: the first bytes of the handshake of a node without security, as of any program without TLS
    let walker = Authority::new("walker");
    let (hip, knee) = (walker.tls("hip", 11), walker.tls("knee", 12));
    let mut wire = Wire::new(hip.client(), knee.server());
    let error = deliver(&mut wire.server, &b"SINW\x01\x00\x00\x00hello from an open node"[..]).unwrap_err();
    let output = words(&error);
    assert!(output.contains("does not speak TLS") && output.contains("without [security]"), "{output}");
}

#[test]
fn endless_hello_is_not_buffered() {
    // Given: a client with an endless hello that claims the maximum length
    let walker = Authority::new("walker");
    let (hip, knee) = (walker.tls("hip", 11), walker.tls("knee", 12));
    let mut wire = Wire::new(hip.client(), knee.server());
    // A handshake record of 16 KiB; its message claims to have 16 MiB.
    let mut record = vec![0x16, 3, 1, 0x40, 0];
    record.extend([1, 0xff, 0xff, 0xff]);
    record.resize(5 + 0x4000, 0);
    let mut taken = 0;
    for _ in 0..100 {
        taken += record.len();
        if deliver(&mut wire.server, &record).is_err() {
            break;
        }
    }
    assert!(taken <= 128 << 10, "it was listened to for {taken} bytes");
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 64, ..ProptestConfig::default() })]

    #[test]
    fn any_bytes_are_rejected_or_incomplete(bytes in prop::collection::vec(any::<u8>(), 0..2_000)) {
        let walker = Authority::new("walker");
        let (hip, knee) = (walker.tls("hip", 11), walker.tls("knee", 12));
        prop_assert!(!is_admitted(&knee, &hip, &bytes));
        let mut client = Wire::new(hip.client(), knee.server()).client;
        let _ = deliver(&mut client, &bytes);
        prop_assert!(!is_open(&client));
    }

    #[test]
    fn any_bytes_are_a_certificate_or_not(bytes in prop::collection::vec(any::<u8>(), 0..600), place: prop::sample::Index) {
        let _ = crate::Certificate::read(bytes.into());
        let walker = Authority::new("walker");
        let own = walker.credentials("hip", 11);
        let mut damaged = own.certificate.der().to_vec();
        let bit = place.index(damaged.len() * 8);
        damaged[bit / 8] ^= 1 << (bit % 8);
        let proven = own.trust.authenticate(&damaged.into(), webpki::KeyUsage::client_auth(), at(NOW));
        prop_assert!(proven.is_err(), "no bit of it may be another one");
    }
}
