//! Tests of `src/robot/gait.rs`.

use super::*;

#[test]
fn rearming_needs_zero_torque_or_an_unsuspicious_walk() {
    let modes = [GaitMode::Hold, GaitMode::Sync, GaitMode::Walk, GaitMode::Safe, GaitMode::Stop];
    let may = |suspect| modes.map(|mode| may_arm(Some(mode), suspect));
    assert_eq!(may(false), [true, true, true, false, true]);
    assert_eq!(may(true), [true, false, false, false, true]);
    assert!(!may_arm(None, false), "nobody is told anything yet");
}
