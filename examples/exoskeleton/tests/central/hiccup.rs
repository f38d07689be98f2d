//! A host that stands still for a moment: the drives damp at once, and assistance comes back where it was.

use exoskeleton::central::Resume;
use exoskeleton::control::drive::{DriveConfig, DriveCore};
use exoskeleton::joint::Joint;
use exoskeleton::message::{DriveState, GaitMode, GaitState, JointSample, Stance};

use crate::{MS, walk::Walk};

/// A central that was released before it heard anybody.
fn standing() -> Walk {
    let mut walk = Walk::new(Resume::ByItself);
    walk.central.release().expect("nobody pressed the e-stop");
    walk
}

#[test]
fn silence_of_30_ms_damps_at_once_and_then_walks_on_with_the_phase_known() {
    let mut walk = Walk::begun(Resume::ByItself);
    let modes: Vec<_> = (0..30).map(|_| walk.hear_nothing(1)).collect();
    assert_eq!(modes[10..], [Some(GaitMode::Safe); 20]);
    let error = walk.phase_error();
    assert_eq!(walk.central.mode(), Some(GaitMode::Walk));
    assert!(error.abs() < 0.05, "{error}");
}

#[test]
fn central_that_stood_still_itself_walks_on_with_the_phase_known() {
    let mut walk = Walk::begun(Resume::ByItself);
    walk.ms += 60;
    // Its first look is at what it heard before it stood still.
    assert_eq!(walk.hear_nothing(1), Some(GaitMode::Safe));
    let error = walk.phase_error();
    assert_eq!(walk.central.mode(), Some(GaitMode::Walk));
    assert!(error.abs() < 0.05, "{error}");
}

#[test]
fn silence_of_30_ms_does_not_begin_the_settling_anew() {
    fn settled(walk: &mut Walk) -> u64 {
        while walk.central.mode() != Some(GaitMode::Walk) {
            walk.hear(1);
        }
        walk.ms
    }
    let undisturbed = settled(&mut standing());
    let mut walk = standing();
    walk.hear(undisturbed - 2_000);
    walk.hear_nothing(30);
    walk.hear(1);
    assert_eq!(walk.central.mode(), Some(GaitMode::Sync));
    assert_eq!(settled(&mut walk), undisturbed);
}

#[test]
fn silence_of_300_ms_makes_the_phase_unknown() {
    let mut walk = Walk::begun(Resume::ByItself);
    walk.hear_nothing(300);
    walk.hear(1);
    assert_eq!(walk.central.mode(), Some(GaitMode::Sync));
}

/// A drive at full assistance that then hears nothing for `silent_ms`: its gain when it walks again.
fn gain_after(silent_ms: u64) -> f64 {
    let mut drive = DriveCore::new(DriveConfig::standard(Joint::Knee));
    let sample = |ms: u64| JointSample {
        seq: ms as u32,
        t_ns: ms * MS,
        t_error_ns: Some(0),
        angle_rad: 0.2,
        velocity_rad_s: 0.0,
        torque_nm: 0.0,
        temperature_c: 30,
        flags: 0,
    };
    let gait = |ms: u64| GaitState {
        seq: ms as u32,
        t_ns: ms * MS,
        t_error_ns: Some(0),
        phase: 0.2,
        phase_rate_hz: 0.8,
        stance: Stance::Stance,
        mode: GaitMode::Walk,
        confidence: 1.0,
        epoch: 1,
        degraded: 0,
    };
    for ms in 1..=1000 {
        drive.tick(ms * MS, Some(&sample(ms)), Some(&gait(ms)));
    }
    for ms in 1001..=1000 + silent_ms {
        drive.tick(ms * MS, None, None);
    }
    assert_eq!(drive.state(), DriveState::Safe);
    let ms = 1001 + silent_ms;
    drive.tick(ms * MS, Some(&sample(ms)), Some(&gait(ms))).assist_gain
}

#[test]
fn drive_that_damped_for_20_ms_goes_on_at_four_fifths_and_after_200_ms_from_zero() {
    assert!((gain_after(30) - 0.8).abs() < 0.02, "{}", gain_after(30));
    assert!(gain_after(210) < 0.01, "{}", gain_after(210));
}
