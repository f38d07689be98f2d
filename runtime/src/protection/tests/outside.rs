//! Bytes from outside: they do no harm, and are judged exactly as documented.

use proptest::prelude::*;

use super::*;

/// Bytes with a valid checksum.
fn summed(bytes: &[u8]) -> Bytes {
    let DataId { source, destination, name } = data_id();
    let mut digest = crc64fast::Digest::new();
    for word in [source.bits(), destination.bits(), name.len() as u64] {
        digest.write(&word.to_le_bytes());
    }
    digest.write(name.as_bytes());
    digest.write(bytes);
    [bytes, &digest.sum64().to_le_bytes()].concat().into()
}

/// A word of an envelope's head: close to the expected value, or random.
#[derive(Clone, Copy, Debug)]
enum Word {
    Near(i8),
    Any(u64),
}

impl Word {
    const fn around(self, good: u64) -> u64 {
        match self {
            Self::Near(off) => good.wrapping_add_signed(off as i64),
            Self::Any(word) => word,
        }
    }
}

/// Most have the expected value.
fn word() -> impl Strategy<Value = Word> {
    prop_oneof![6 => Just(Word::Near(0)), 3 => (-9_i8..=9).prop_map(Word::Near), 1 => any::<u64>().prop_map(Word::Any)]
}

proptest! {
    #[test]
    fn bytes_are_rejected_and_never_panic(bytes in prop::collection::vec(any::<u8>(), 0..128)) {
        let mut bench = Bench::live();
        prop_assert_eq!(bench.take(&bytes.into()), Verdict::Refused(ProtectionError::Corrupt));
        prop_assert!(bench.applies_the_next());
    }

    #[test]
    fn valid_checksum_without_a_head_is_rejected(bytes in prop::collection::vec(any::<u8>(), 0..128)) {
        prop_assume!(bytes.len() < 32 || bytes[..4] != [1, 0, 0, 0]);
        let mut bench = Bench::live();
        prop_assert_eq!(bench.take(&summed(&bytes)), Verdict::Refused(ProtectionError::Corrupt));
        prop_assert!(bench.applies_the_next());
    }

    #[test]
    fn valid_checksum_is_judged_by_its_head(
        head in [word(), word(), word(), word(), word()],
        is_echo_near in any::<bool>(),
        payload in prop::collection::vec(any::<u8>(), 0..32),
    ) {
        let mut bench = Bench::live();
        prop_assert!(bench.applies_the_next());
        // The expected message.
        bench.next();
        let (last, now) = (bench.sent - 1, bench.now.as_nanos());
        let version = head[0].around(1) as u32;
        let length = head[1].around(payload.len() as u64) as u32;
        let counter = head[2].around(last + 1);
        let incarnation = head[3].around(LIFE.as_nanos());
        // Close by periods, or by nanoseconds.
        let echo = match head[4] {
            Word::Near(off) if is_echo_near => now.wrapping_add_signed(i64::from(off) * 1_000_000),
            Word::Near(_) | Word::Any(_) => head[4].around(now),
        };
        let mut bytes = [version.to_le_bytes(), length.to_le_bytes()].concat();
        for word in [counter, incarnation, echo] {
            bytes.extend(word.to_le_bytes());
        }
        bytes.extend(&payload);

        let is_known = version == 1 && length as usize == payload.len();
        // Eight echoes are known, a millisecond apart, the newest at the current time; the oldest of them is
        // seven old.
        let is_young = (0..8).any(|ago| echo == now - ago * 1_000_000);
        let expected = match counter {
            _ if !is_known => Verdict::Refused(ProtectionError::Corrupt),
            _ if !is_young => Verdict::Refused(ProtectionError::TooOld),
            _ if incarnation != LIFE.as_nanos() => Verdict::Refused(ProtectionError::Restarted),
            counter if counter == last => Verdict::Refused(ProtectionError::Repeated),
            counter if counter < last => Verdict::Refused(ProtectionError::Backwards),
            counter if counter > last + 3 => Verdict::Refused(ProtectionError::Gap),
            _ => Verdict::Apply(payload.into()),
        };
        prop_assert_eq!(bench.take(&summed(&bytes)), expected);
    }
}
