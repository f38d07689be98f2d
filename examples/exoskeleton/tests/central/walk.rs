//! A leg that walks as intended, and the central that hears it.

use exoskeleton::central::{CentralConfig, CentralCore, CentralInput, Resume};
use exoskeleton::control::faults::FaultBits;
use exoskeleton::intention::Intention;
use exoskeleton::joint::Joint;
use exoskeleton::message::{DriveState, DriveStatus, FootLoad, GaitMode, GaitState, JointSample};
use exoskeleton::phase::wrapped;

use crate::MS;

/// A leg that walks as intended, heard by central.
pub(crate) struct Walk {
    pub(crate) central: CentralCore,
    intention: Intention,
    /// Milliseconds since the beginning.
    pub(crate) ms: u64,
    /// What the drives say; none: nothing.
    pub(crate) says: [Option<(DriveState, FaultBits)>; 3],
}

impl Walk {
    pub(crate) fn new(resume: Resume) -> Self {
        let central = CentralCore::new(CentralConfig { resume, ..CentralConfig::default() });
        let says = [Some((DriveState::Ready, FaultBits(0))); 3];
        Self { central, intention: Intention::from_curves(3), ms: 0, says }
    }

    /// A central that was released and lets the drives assist.
    pub(crate) fn begun(resume: Resume) -> Self {
        let mut walk = Self::new(resume);
        walk.hear(10);
        walk.central.release().expect("nobody pressed the e-stop");
        walk.hear(9_990);
        walk.says = [Some((DriveState::Walk, FaultBits(0))); 3];
        assert_eq!(walk.hear(10).mode, GaitMode::Walk);
        walk
    }

    /// Milliseconds in which central hears everybody; the last state.
    pub(crate) fn hear(&mut self, ms: u64) -> GaitState {
        (0..ms).map(|_| self.tick(true)).last().flatten().expect("all parts are there")
    }

    /// A millisecond in which central hears everybody; the error of its phase.
    pub(crate) fn phase_error(&mut self) -> f64 {
        let phase = f64::from(self.hear(1).phase);
        wrapped(phase - self.intention.at(self.ms as f64 * 1e-3).strides)
    }

    /// Milliseconds in which it hears nobody; the last mode.
    pub(crate) fn hear_nothing(&mut self, ms: u64) -> Option<GaitMode> {
        (0..ms).map(|_| self.tick(false)).last().flatten().map(|state| state.mode)
    }

    fn tick(&mut self, heard: bool) -> Option<GaitState> {
        self.ms += 1;
        if !heard {
            return self.central.tick(self.ms * MS, &CentralInput::default());
        }
        self.hear_drives();
        let (t_ns, seq) = (self.ms * MS, self.ms as u32);
        let intended = self.intention.at(self.ms as f64 * 1e-3);
        let samples = Joint::ALL.map(|joint| JointSample {
            seq,
            t_ns,
            t_error_ns: Some(0),
            angle_rad: intended.angle_rad[joint.index()] as f32,
            velocity_rad_s: 0.0,
            torque_nm: 0.0,
            temperature_c: 30,
            flags: 0,
        });
        let load_n = intended.vertical_load_bw * 80.0 * 9.81;
        let load = FootLoad { seq, t_ns, t_error_ns: Some(0), heel_n: load_n as f32, toe_n: 0.0 };
        let input = CentralInput { samples: samples.each_ref().map(Some), load: Some(&load) };
        self.central.tick(t_ns, &input)
    }

    /// Every fifth millisecond.
    fn hear_drives(&mut self) {
        let (t_ns, seq) = (self.ms * MS, self.ms as u32);
        for (joint, says) in Joint::ALL.into_iter().zip(self.says) {
            let Some((state, faults)) = says.filter(|_| seq.is_multiple_of(5)) else { continue };
            self.central.drive_heard(t_ns, joint, &status(seq, (t_ns, Some(0)), (state, faults)));
        }
    }

    /// Central hears a drive now, from then: ns, and how much earlier that may have been.
    pub(crate) fn hears_late(
        &mut self,
        joint: Joint,
        says: (DriveState, FaultBits),
        when: (u64, Option<u64>),
    ) {
        self.central.drive_heard(self.ms * MS, joint, &status(self.ms as u32, when, says));
    }
}

fn status(
    seq: u32,
    (t_ns, t_error_ns): (u64, Option<u64>),
    (state, faults): (DriveState, FaultBits),
) -> DriveStatus {
    DriveStatus {
        seq,
        t_ns,
        t_error_ns,
        state,
        faults: faults.0,
        torque_nm: 0.0,
        age_max_us: None,
        misses: 0,
        commands_taken: 0,
        commands_refused: 0,
    }
}
