//! A host that stands still for a moment: the drives damp at once, and assistance comes back where it was.

use exoskeleton::central::{CentralConfig, CentralCore, CentralInput, Resume};
use exoskeleton::control::drive::{DriveConfig, DriveCore};
use exoskeleton::intention::Intention;
use exoskeleton::joint::Joint;
use exoskeleton::message::{DriveState, FootLoad, GaitMode, GaitState, JointSample, Stance};
use exoskeleton::phase::wrapped;

const MS: u64 = 1_000_000;

/// A leg that walks as intended, heard by central.
struct Walk {
    central: CentralCore,
    intention: Intention,
    ms: u64,
}

impl Walk {
    fn standing() -> Self {
        let mut central =
            CentralCore::new(CentralConfig { resume: Resume::ByItself, ..CentralConfig::default() });
        central.release().expect("nobody pressed the e-stop");
        Self { central, intention: Intention::from_curves(3), ms: 0 }
    }

    fn begun() -> Self {
        let mut walk = Self::standing();
        for _ in 0..10_000 {
            walk.hear();
        }
        assert_eq!(walk.central.mode(), Some(GaitMode::Walk));
        walk
    }

    /// One millisecond in which central hears everybody; the error of its phase.
    fn hear(&mut self) -> f64 {
        self.ms += 1;
        let (t_ns, seq) = (self.ms * MS, self.ms as u32);
        let intended = self.intention.at(self.ms as f64 * 1e-3);
        let samples = Joint::ALL.map(|joint| JointSample {
            seq,
            t_ns,
            angle_rad: intended.angle_rad[joint.index()] as f32,
            velocity_rad_s: 0.0,
            torque_nm: 0.0,
            temperature_c: 30,
            flags: 0,
        });
        let load_n = intended.vertical_load_bw * 80.0 * 9.81;
        let load = FootLoad { seq, t_ns, heel_n: load_n as f32, toe_n: 0.0 };
        let input = CentralInput { samples: samples.each_ref().map(Some), load: Some(&load) };
        let state = self.central.tick(t_ns, &input).expect("all parts are there");
        wrapped(f64::from(state.phase) - intended.strides)
    }

    /// One millisecond in which it hears nobody.
    fn hear_nothing(&mut self) -> Option<GaitMode> {
        self.ms += 1;
        self.central.tick(self.ms * MS, &CentralInput::default()).map(|state| state.mode)
    }
}

#[test]
fn silence_of_30_ms_damps_at_once_and_then_walks_on_with_the_phase_known() {
    let mut walk = Walk::begun();
    let modes: Vec<_> = (0..30).map(|_| walk.hear_nothing()).collect();
    assert_eq!(modes[10..], [Some(GaitMode::Safe); 20]);
    let error = walk.hear();
    assert_eq!(walk.central.mode(), Some(GaitMode::Walk));
    assert!(error.abs() < 0.05, "{error}");
}

#[test]
fn central_that_stood_still_itself_walks_on_with_the_phase_known() {
    let mut walk = Walk::begun();
    walk.ms += 60;
    // Its first look is at what it heard before it stood still.
    assert_eq!(walk.hear_nothing(), Some(GaitMode::Safe));
    let error = walk.hear();
    assert_eq!(walk.central.mode(), Some(GaitMode::Walk));
    assert!(error.abs() < 0.05, "{error}");
}

#[test]
fn silence_of_30_ms_does_not_begin_the_settling_anew() {
    fn settled(walk: &mut Walk) -> u64 {
        while walk.central.mode() != Some(GaitMode::Walk) {
            walk.hear();
        }
        walk.ms
    }
    let undisturbed = settled(&mut Walk::standing());
    let mut walk = Walk::standing();
    for _ in 0..undisturbed - 2_000 {
        walk.hear();
    }
    for _ in 0..30 {
        walk.hear_nothing();
    }
    walk.hear();
    assert_eq!(walk.central.mode(), Some(GaitMode::Sync));
    assert_eq!(settled(&mut walk), undisturbed);
}

#[test]
fn silence_of_300_ms_makes_the_phase_unknown() {
    let mut walk = Walk::begun();
    for _ in 0..300 {
        walk.hear_nothing();
    }
    walk.hear();
    assert_eq!(walk.central.mode(), Some(GaitMode::Sync));
}

/// A drive at full assistance that then hears nothing for `silent_ms`: its gain when it walks again.
fn gain_after(silent_ms: u64) -> f64 {
    let mut drive = DriveCore::new(DriveConfig::standard(Joint::Knee));
    let sample = |ms: u64| JointSample {
        seq: ms as u32,
        t_ns: ms * MS,
        angle_rad: 0.2,
        velocity_rad_s: 0.0,
        torque_nm: 0.0,
        temperature_c: 30,
        flags: 0,
    };
    let gait = |ms: u64| GaitState {
        seq: ms as u32,
        t_ns: ms * MS,
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
