//! A leg that walks as intended, and the central that receives its inputs.

use exoskeleton_model::central::{CentralConfig, CentralCore, CentralInput, Resume};
use exoskeleton_model::control::faults::FaultBits;
use exoskeleton_model::intention::Intention;
use exoskeleton_model::joint::Joint;
use exoskeleton_model::message::{DriveState, DriveStatus, FootLoad, GaitMode, GaitState, JointSample};
use exoskeleton_model::phase::wrapped;

use super::MS;

/// A leg that walks as intended, with its central.
pub(crate) struct Walk {
    pub(crate) central: CentralCore,
    intention: Intention,
    /// Milliseconds since the beginning.
    pub(crate) ms: u64,
    /// The reports of the drives; `None`: no report.
    pub(crate) reports: [Option<(DriveState, FaultBits)>; 3],
}

impl Walk {
    pub(crate) fn new(resume: Resume) -> Self {
        let central = CentralCore::new(CentralConfig { resume, ..CentralConfig::default() });
        let reports = [Some((DriveState::Ready, FaultBits(0))); 3];
        Self { central, intention: Intention::from_curves(3), ms: 0, reports }
    }

    /// A central that was released and allows assistance.
    pub(crate) fn begun(resume: Resume) -> Self {
        let mut walk = Self::new(resume);
        walk.receive(10);
        walk.central.release().expect("the e-stop was not pressed");
        walk.receive(9_990);
        walk.reports = [Some((DriveState::Walk, FaultBits(0))); 3];
        assert_eq!(walk.receive(10).mode, GaitMode::Walk);
        walk
    }

    /// Runs milliseconds in which central receives from all parts; returns the last state.
    pub(crate) fn receive(&mut self, ms: u64) -> GaitState {
        (0..ms).map(|_| self.tick(true)).last().flatten().expect("all parts are there")
    }

    /// Runs a millisecond in which central receives from all parts; returns the error of its phase.
    pub(crate) fn phase_error(&mut self) -> f64 {
        let phase = f64::from(self.receive(1).phase);
        wrapped(phase - self.intention.at(self.ms as f64 * 1e-3).strides)
    }

    /// Runs milliseconds in which it receives nothing; returns the last mode.
    pub(crate) fn receive_nothing(&mut self, ms: u64) -> Option<GaitMode> {
        (0..ms).map(|_| self.tick(false)).last().flatten().map(|state| state.mode)
    }

    fn tick(&mut self, has_input: bool) -> Option<GaitState> {
        self.ms += 1;
        if !has_input {
            return self.central.tick(self.ms * MS, &CentralInput::default());
        }
        self.receive_drives();
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
    fn receive_drives(&mut self) {
        let (t_ns, seq) = (self.ms * MS, self.ms as u32);
        for (joint, report) in Joint::ALL.into_iter().zip(self.reports) {
            let Some((state, faults)) = report.filter(|_| seq.is_multiple_of(5)) else { continue };
            self.central.on_drive_status(t_ns, joint, &status(seq, (t_ns, Some(0)), (state, faults)));
        }
    }

    /// Central receives a status now, with this time, ns, and its maximum error toward earlier.
    pub(crate) fn receive_late(
        &mut self,
        joint: Joint,
        report: (DriveState, FaultBits),
        when: (u64, Option<u64>),
    ) {
        self.central.on_drive_status(self.ms * MS, joint, &status(self.ms as u32, when, report));
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
