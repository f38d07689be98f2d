//! Headers survive the wire, damage to them is noticed, and their times to live are bounded.

use proptest::prelude::*;

use super::*;

fn any_header() -> impl Strategy<Value = Header> {
    (any::<[u64; 5]>(), any::<[u32; 2]>(), any::<u16>(), 0u8..3, 0u8..16).prop_map(
        |(long, short, number, class, flags)| Header {
            kind: Kind::from_bits(short[0]),
            class: Class::from_code(class).unwrap(),
            flags: Flags(flags),
            source: Tid::from_bits(long[0]),
            destination: Tid::from_bits(long[1]),
            number,
            sequence: long[2],
            correlation: long[3],
            sent: Time::from_nanos(long[4]),
            time_to_live_us: short[1],
        },
    )
}

proptest! {
    #[test]
    fn header_round_trips(header in any_header(), payload: Vec<u8>) {
        prop_assert_eq!(Header::decode(&header.encode(&payload), &payload), Ok(header));
    }

    #[test]
    fn checksum_is_the_crc_of_header_and_payload(header in any_header(), payload: Vec<u8>) {
        let bytes = header.encode(&payload);
        let crc = crc32fast::hash(&[&bytes[..60], &payload[..]].concat());
        prop_assert_eq!(u32::from_le_bytes(field(&bytes, 60)), crc);
    }

    #[test]
    fn one_flipped_bit_is_noticed(header in any_header(), payload: Vec<u8>, bit in 0usize..512) {
        let mut bytes = header.encode(&payload);
        bytes[bit / 8] ^= 1 << (bit % 8);
        prop_assert!(Header::decode(&bytes, &payload).is_err());
    }

    #[test]
    fn guarded_header_is_readable_without_guard_support(
        header in any_header(), payload: Vec<u8>,
    ) {
        let header = Header { sequence: header.sequence & SEQUENCE_MAX, ..header };
        let bytes = header.encode_guarded(&payload);
        prop_assert_eq!(Header::check_guard(&bytes), Ok(()));
        prop_assert_eq!(Header::decode_guarded(&bytes, &payload), Ok(header));
        let plain = Header::decode(&bytes, &payload).unwrap();
        prop_assert_eq!(Header { sequence: header.sequence, ..plain }, header);
    }

    #[test]
    fn flipped_bits_in_a_guarded_length_are_noticed(
        header in any_header(), payload: Vec<u8>, first in 32usize..80, second in 32usize..80,
    ) {
        let mut bytes = header.encode_guarded(&payload);
        // Of 48 bits the first 32 are the length, the others the guard.
        let mut flip = |bit: usize| {
            let bit = if bit < 64 { bit } else { GUARD_AT * 8 + bit - 64 };
            bytes[bit / 8] ^= 1 << (bit % 8);
        };
        flip(first);
        if second != first {
            flip(second);
        }
        prop_assert_eq!(Header::check_guard(&bytes), Err(HeaderError::Guard));
    }

    #[test]
    fn any_bytes_are_a_header_or_an_error(bytes in proptest::collection::vec(any::<u8>(), 64), payload: Vec<u8>) {
        let bytes: [u8; 64] = bytes.try_into().unwrap();
        let _ = Header::decode(&bytes, &payload);
    }
}

#[test]
fn checksum_of_any_length_is_the_crc() {
    let payload: Vec<u8> = (0..600_u32).map(|n| (n * 7 + n / 256) as u8).collect();
    for length in 0..payload.len() {
        let (header, payload) = (Header::new(Kind::OUTCOME, Tid::BROADCAST, Tid::NONE), &payload[..length]);
        let bytes = header.encode(payload);
        let crc = crc32fast::hash(&[&bytes[..60], payload].concat());
        assert_eq!(u32::from_le_bytes(field(&bytes, 60)), crc, "{length} bytes");
    }
}

#[test]
fn other_version_is_reported_before_other_fields() {
    let mut bytes = Header::new(Kind::OUTCOME, Tid::NONE, Tid::NONE).encode(&[]);
    bytes[2] = 9;
    assert_eq!(Header::decode(&bytes, &[]), Err(HeaderError::Version { theirs: 9 }));
}

#[test]
fn long_time_to_live_is_capped_and_never_endless() {
    let (micro, most) = (Duration::from_micros(1), TIME_TO_LIVE_MAX);
    assert_eq!(most.as_secs(), 71 * 60 + 34, "and 0.967 s: 71 minutes and 35 s, as the documentation says");
    let cases = [
        (Duration::ZERO, 1, Duration::ZERO),
        (Duration::from_nanos(1), 1, Duration::from_nanos(1)),
        (Duration::from_secs(3_600), 3_600_000_000, Duration::from_secs(3_600)),
        (most - micro, u32::MAX - 1, most - micro),
        (most, u32::MAX, most),
        (most + micro, u32::MAX, most),
        // Cut to 32 bits these would be 1 us and 2 us.
        (micro * 2 + most, u32::MAX, most),
        (Duration::from_secs(48 * 3_600), u32::MAX, most),
        (Duration::MAX, u32::MAX, most),
    ];
    for (within, micros, waits) in cases {
        let mut header = Header::new(Kind::OUTCOME, Tid::NONE, Tid::NONE);
        assert_eq!((header.set_time_to_live(within), header.time_to_live_us), (waits, micros), "{within:?}");
    }
}

#[test]
fn time_to_live_counts_from_the_send_time() {
    let mut header = Header::new(Kind::OUTCOME, Tid::NONE, Tid::NONE);
    header.sent = Time::from_nanos(1_000);
    assert!(!header.is_expired(Time::MAX));
    header.time_to_live_us = 1;
    assert!(!header.is_expired(Time::from_nanos(2_000)));
    assert!(header.is_expired(Time::from_nanos(2_001)));
}
