//! The guard of a frame's length: the lower 16 bits of the CRC-32 of its first 8 bytes.
//!
//! The first four of these bytes are the same in every frame. The other four are the length, so that a table
//! of effects for each of them replaces the computation. Both sides compute the guard of each frame.

use super::{HEADER_LEN, MAGIC, VERSION};

/// The polynomial of the CRC-32 (IEEE 802.3), reflected.
const POLYNOMIAL: u32 = 0xedb8_8320;

/// The state of the CRC-32 behind the first four bytes of a frame.
const STATE: u32 = state_behind([MAGIC[0], MAGIC[1], VERSION, HEADER_LEN as u8]);

/// The effect of each byte of the length on the guard, by its distance from the end.
static EFFECTS: [[u16; 256]; 4] = effects();

/// Returns the guard of a payload's length.
#[inline]
pub(super) fn guard_of(length: u32) -> [u8; 2] {
    let [first, second, third, last] = (STATE ^ length).to_le_bytes().map(usize::from);
    let crc = EFFECTS[3][first] ^ EFFECTS[2][second] ^ EFFECTS[1][third] ^ EFFECTS[0][last];
    (!crc).to_le_bytes()
}

const fn state_behind(bytes: [u8; 4]) -> u32 {
    let (mut state, mut at) = (u32::MAX, 0);
    while at < bytes.len() {
        state = shifted(state ^ bytes[at] as u32);
        at += 1;
    }
    state
}

/// Returns the state after one byte of zeros.
const fn shifted(mut state: u32) -> u32 {
    let mut bit = 0;
    while bit < 8 {
        state = if state & 1 == 1 { (state >> 1) ^ POLYNOMIAL } else { state >> 1 };
        bit += 1;
    }
    state
}

const fn effects() -> [[u16; 256]; 4] {
    let mut effects = [[0; 256]; 4];
    let mut byte = 0;
    while byte < 256 {
        let (mut state, mut distance) = (byte as u32, 0);
        while distance < effects.len() {
            state = shifted(state);
            effects[distance][byte] = state as u16;
            distance += 1;
        }
        byte += 1;
    }
    effects
}

#[cfg(test)]
mod tests {
    use proptest::prelude::*;

    use super::*;

    proptest! {
        #[test]
        fn guard_is_the_lower_half_of_a_crc(length: u32) {
            let [first, second, third, last] = length.to_le_bytes();
            let start = [MAGIC[0], MAGIC[1], VERSION, HEADER_LEN as u8, first, second, third, last];
            prop_assert_eq!(u16::from_le_bytes(guard_of(length)), crc32fast::hash(&start) as u16);
        }
    }
}
