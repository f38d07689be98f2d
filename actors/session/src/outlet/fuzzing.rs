//! Fuzzing of frames with several outcomes, each alone or in runs.

use sinew_runtime::{tid::NodeAddress, wire::Kind};

use super::{OUTCOMES_MAX, read_outcomes};

/// Bytes of one outcome among several.
const EACH: usize = 17;
/// Bytes of one run of outcomes.
const RUN: usize = 18;

pub fn said() -> Vec<Vec<u8>> {
    vec![vec![0; EACH], vec![1; 2 * EACH], vec![2; 3 * RUN]]
}

pub fn words(bytes: &[u8]) -> bool {
    let is_each = play(Kind::GNCL_OUTCOMES, EACH, bytes);
    play(Kind::GNCL_OUTCOME_RUNS, RUN, bytes) || is_each
}

fn play(kind: Kind, entry: usize, bytes: &[u8]) -> bool {
    let Some(all) = read_outcomes(kind, bytes) else { return false };
    let (mut entries, mut messages) = (0, 0);
    for reported in all {
        let count = usize::from(reported.count);
        (entries, messages) = (entries + 1, messages + count);
        if let Some(run) = reported.run(NodeAddress::new(1), NodeAddress::new(2)) {
            assert_eq!(run.len(), count);
        }
    }
    assert!((1..=OUTCOMES_MAX).contains(&messages) && entries * entry == bytes.len());
    true
}
