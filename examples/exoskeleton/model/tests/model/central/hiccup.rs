//! A host that stands still for a moment: the drives damp at once, and assistance returns to its previous
//! level.

use exoskeleton_model::central::Resume;
use exoskeleton_model::control::drive::{DriveConfig, DriveCore};
use exoskeleton_model::joint::Joint;
use exoskeleton_model::message::{DriveState, GaitMode, GaitState, JointSample, Stance};

use super::{MS, walk::Walk};

/// A central that was released before it received any input.
fn standing() -> Walk {
    let mut walk = Walk::new(Resume::ByItself);
    walk.central.release().expect("the e-stop was not pressed");
    walk
}

#[test]
fn short_silence_damps_and_keeps_the_phase() {
    let mut walk = Walk::begun(Resume::ByItself);
    let modes: Vec<_> = (0..30).map(|_| walk.receive_nothing(1)).collect();
    assert_eq!(modes[10..], [Some(GaitMode::Safe); 20]);
    let error = walk.phase_error();
    assert_eq!(walk.central.mode(), Some(GaitMode::Walk));
    assert!(error.abs() < 0.05, "{error}");
}

#[test]
fn central_keeps_the_phase_over_its_own_stall() {
    let mut walk = Walk::begun(Resume::ByItself);
    walk.ms += 60;
    // Its first tick uses the inputs from before it stood still.
    assert_eq!(walk.receive_nothing(1), Some(GaitMode::Safe));
    let error = walk.phase_error();
    assert_eq!(walk.central.mode(), Some(GaitMode::Walk));
    assert!(error.abs() < 0.05, "{error}");
}

#[test]
fn silence_of_30_ms_does_not_restart_settling() {
    fn settled(walk: &mut Walk) -> u64 {
        while walk.central.mode() != Some(GaitMode::Walk) {
            walk.receive(1);
        }
        walk.ms
    }
    let undisturbed = settled(&mut standing());
    let mut walk = standing();
    walk.receive(undisturbed - 2_000);
    walk.receive_nothing(30);
    walk.receive(1);
    assert_eq!(walk.central.mode(), Some(GaitMode::Sync));
    assert_eq!(settled(&mut walk), undisturbed);
}

#[test]
fn silence_of_300_ms_makes_the_phase_unknown() {
    let mut walk = Walk::begun(Resume::ByItself);
    walk.receive_nothing(300);
    walk.receive(1);
    assert_eq!(walk.central.mode(), Some(GaitMode::Sync));
}

/// A drive at full assistance without inputs for `silent_ms`: its gain when it walks again.
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
fn gain_falls_to_zero_within_200_ms() {
    assert!((gain_after(30) - 0.8).abs() < 0.02, "{}", gain_after(30));
    assert!(gain_after(210) < 0.01, "{}", gain_after(210));
}
