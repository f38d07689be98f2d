//! Central's view of the three drives: which assist, which do not, and which were stopped.

use crate::control::faults::FaultBits;
use crate::joint::{Joint, PerJoint};
use crate::message::{DriveState, DriveStatus};

/// Maximum time that one tick adds to a silence, seconds: while central itself was delayed it received
/// nothing.
const TICK_LONGEST_S: f64 = 0.005;

/// The state of the drives as far as central knows.
#[derive(Debug, Clone, Copy)]
pub(super) struct Drives {
    silence_max_s: f64,
    /// Maximum time since a drive reported that it assists, seconds.
    unassisted_s: PerJoint<f64>,
    /// Time of its last report that its e-stop was pressed, ns; `None`: it has since reported otherwise.
    stopped_ns: PerJoint<Option<u64>>,
    /// Time at which its last incarnation is known to have ended, ns: older reports do not count for the next
    /// one.
    ended_ns: PerJoint<u64>,
}

impl Drives {
    pub(super) const fn new(silence_max_s: f64) -> Self {
        Self { silence_max_s, unassisted_s: [0.0; 3], stopped_ns: [None; 3], ended_ns: [0; 3] }
    }

    /// The incarnation of a drive has ended; it is degraded until its next one reports that it assists.
    pub(super) const fn ended(&mut self, joint: Joint, now_ns: u64) {
        self.ended_ns[joint.index()] = now_ns;
        self.unassisted_s[joint.index()] = f64::INFINITY;
    }

    /// Processes the status of a drive.
    ///
    /// A report that it was stopped always counts, even if it is old, of unknown age, or of an earlier
    /// incarnation: an unnecessary stop is acceptable. All other reports count only if they were certainly
    /// sent after the end of the previous incarnation, and after the last report of a stop arrived.
    pub(super) fn on_status(&mut self, now_ns: u64, joint: Joint, status: &DriveStatus) {
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

    /// Advances time; the silence of a drive that should not assist does not count.
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
