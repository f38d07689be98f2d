//! Random mutation of known inputs, for a driver without a fuzzer. The caller supplies the random generator.

use fastrand::Rng;

/// Maximum length of an input, in bytes: some frames, each with a header.
const LENGTH_MAX: usize = 4_096;
/// Maximum number of changes to one input.
const CHANGES_MAX: usize = 8;

/// Returns one of `inputs` with some changes, possibly spliced with a part of another one.
#[must_use]
pub fn mutate(random: &mut Rng, inputs: &[Vec<u8>]) -> Vec<u8> {
    let any = |random: &mut Rng| random.choice(inputs).cloned().unwrap_or_default();
    let mut bytes = any(random);
    for _ in 0..random.usize(1..=CHANGES_MAX) {
        let at = random.usize(0..=bytes.len());
        match random.u8(0..10) {
            0 | 1 => change(&mut bytes, at, |byte| byte ^ 1 << random.u8(0..8)),
            2 => change(&mut bytes, at, |_| random.u8(..)),
            3 => change(&mut bytes, at, |byte| byte.wrapping_add(random.u8(..).wrapping_sub(128) / 8)),
            4 => bytes.insert(at, random.u8(..)),
            5 => {
                let until = (at + random.usize(1..=16)).min(bytes.len());
                bytes.drain(at..until);
            }
            6 => bytes.truncate(at),
            7 => {
                // A number near the minimum or maximum of its type, of any width.
                let width = 1 << random.u32(0..=3);
                let number =
                    *random.choice(&[0, 1, u64::MAX, u64::MAX >> 1, 1 << 31, 1 << 16, 1 << 13]).unwrap_or(&0);
                for (byte, new) in bytes.iter_mut().skip(at).zip(number.to_le_bytes()).take(width) {
                    *byte = new;
                }
            }
            8 => {
                let other = any(random);
                let from = random.usize(0..=other.len());
                let count = random.usize(0..=other.len() - from);
                bytes.splice(at..at, other[from..from + count].iter().copied());
            }
            _ => {
                let count = random.usize(0..=32.min(bytes.len() - at));
                let twice = bytes[at..at + count].to_vec();
                bytes.splice(at..at, twice);
            }
        }
    }
    bytes.truncate(LENGTH_MAX.max(inputs.first().map_or(0, Vec::len)));
    bytes
}

fn change(bytes: &mut [u8], at: usize, new: impl FnOnce(u8) -> u8) {
    if let Some(byte) = bytes.get_mut(at) {
        *byte = new(*byte);
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    #[test]
    fn same_seed_gives_same_inputs_of_bounded_length() {
        let inputs = [vec![0; 10], vec![7; LENGTH_MAX], Vec::new()];
        let of = |seed| {
            let mut random = Rng::with_seed(seed);
            (0..1_000).map(|_| mutate(&mut random, &inputs)).collect::<Vec<_>>()
        };
        assert_eq!(of(1), of(1));
        assert_ne!(of(1), of(2));
        assert!(of(1).iter().all(|input| input.len() <= LENGTH_MAX));
    }
}
