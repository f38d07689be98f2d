//! Tests of `src/robot/figures.rs`.

use super::*;

#[test]
fn turns_skipped_by_a_late_tick_count_as_missed() {
    assert_eq!([0, 2_000, 2_001, 3_000, 3_001, 5_200].map(misses), [0, 0, 1, 1, 2, 4]);
}
