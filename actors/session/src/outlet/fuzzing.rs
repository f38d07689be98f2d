//! Fuzzing of frames with several outcomes.

use super::{OUTCOMES_MAX, read_outcomes};

/// Bytes of one outcome among several.
const EACH: usize = 17;

pub fn said() -> Vec<Vec<u8>> {
    vec![vec![0; EACH], vec![1; 2 * EACH]]
}

pub fn words(bytes: &[u8]) -> bool {
    let Some(all) = read_outcomes(bytes) else { return false };
    let count = all.count();
    assert!((1..=OUTCOMES_MAX).contains(&count) && count * EACH == bytes.len());
    true
}
