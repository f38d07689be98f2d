//! What central knows of the three drives: who helps, who does not, who was stopped.

use crate::control::faults::FaultBits;
use crate::joint::{Joint, PerJoint};
use crate::message::{DriveState, DriveStatus};

/// Time that one tick adds to a silence at most, seconds: when central itself was held up it has heard nobody.
const TICK_LONGEST_S: f64 = 0.005;

/// The drives as central sees them.
#[derive(Debug, Clone, Copy)]
pub(super) struct Drives {
    silence_max_s: f64,
    /// Time since a drive said that it assists, at most, seconds.
    unassisted_s: PerJoint<f64>,
    /// When it was heard last to say that its e-stop was pressed, ns; `None`: it has said since that it is not.
    stopped_ns: PerJoint<Option<u64>>,
    /// When its last life is known to have ended, ns: what it said before is no sign of the next one.
    ended_ns: PerJoint<u64>,
}

impl Drives {
    pub(super) const fn new(silence_max_s: f64) -> Self {
        Self { silence_max_s, unassisted_s: [0.0; 3], stopped_ns: [None; 3], ended_ns: [0; 3] }
    }

    /// The life of a drive has ended; it is degraded until its next one says that it assists.
    pub(super) const fn ended(&mut self, joint: Joint, now_ns: u64) {
        self.ended_ns[joint.index()] = now_ns;
        self.unassisted_s[joint.index()] = f64::INFINITY;
    }

    /// A drive has told how it is.
    ///
    /// That it was stopped counts however old the word is, and of whichever life, also where no age is known: it stops once too often. All
    /// else counts only if it was surely said after the end of the life before, and after the last such word had come.
    pub(super) fn heard(&mut self, now_ns: u64, joint: Joint, status: &DriveStatus) {
        let index = joint.index();
        if FaultBits(status.faults).contains(FaultBits::STOPPED) {
            self.stopped_ns[index] = Some(now_ns);
            return;
        }
        let Some(error_ns) = status.t_error_ns else { return };
        let earliest_ns = status.t_ns.saturating_sub(error_ns);
        if earliest_ns <= self.ended_ns[index].max(self.stopped_ns[index].unwrap_or(0)) {
            return;
        }
        self.stopped_ns[index] = None;
        if matches!(status.state, DriveState::Walk) {
            let silent_s = now_ns.saturating_sub(earliest_ns) as f64 * 1e-9;
            self.unassisted_s[index] = self.unassisted_s[index].min(silent_s);
        }
    }

    /// Time has passed; a drive that is not asked to assist owes nothing.
    pub(super) fn tick(&mut self, dt_s: f64, assistance_is_due: bool) {
        for silence_s in &mut self.unassisted_s {
            *silence_s = if assistance_is_due { *silence_s + dt_s.min(TICK_LONGEST_S) } else { 0.0 };
        }
    }

    /// Joints that walk without their drive's help: bit 0 hip, bit 1 knee, bit 2 ankle.
    pub(super) fn degraded(&self) -> u8 {
        Joint::ALL
            .into_iter()
            .filter(|joint| self.unassisted_s[joint.index()] > self.silence_max_s)
            .fold(0, |bits, joint| bits | bit(joint))
    }

    pub(super) fn any_stopped(&self) -> bool {
        self.stopped_ns.iter().any(Option::is_some)
    }
}

/// The bit of a joint in `GaitState::degraded`.
#[must_use]
pub const fn bit(joint: Joint) -> u8 {
    1 << joint.index()
}
