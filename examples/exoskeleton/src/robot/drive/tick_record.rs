//! The record of a tick, from which a recording computes it again.

use exoskeleton_model::control::drive::DriveOutput;
use exoskeleton_model::control::torque_law::{Gains, TorqueLaw};
use exoskeleton_model::message::{DriveTick, GaitState};
use sinew::prelude::*;

use super::{Drive, micros};
use crate::robot::edges::TICKS;

impl Drive {
    /// Returns the inputs and the gains of a tick that is about to be computed, if ticks are recorded.
    pub(super) fn tick_record(
        &self,
        now: Time,
        tick: Tick,
        (gait, is_shut): (Option<&GaitState>, bool),
        gains: Gains,
    ) -> Option<DriveTick> {
        self.parts.sends_ticks.then(|| DriveTick {
            joint: self.parts.joint.index() as u8,
            seq: tick.number as u32,
            t_ns: now.as_nanos(),
            late_us: micros(tick.lateness),
            before: self.core.state(),
            is_shut,
            sample: self.sample.as_ref().map(Into::into),
            gait: gait.map(Into::into),
            gains: (gains != TorqueLaw::standard(self.parts.joint).gains).then_some(gains),
            torque_nm: None,
            assist_gain: 0.0,
            state: self.core.state(),
            damped_at_ns: None,
        })
    }

    /// Sends a record with its result. The device has its order already, which this does not delay.
    pub(super) fn send_record(&self, record: &DriveTick, computed: &DriveOutput, context: &AppContext<Self>) {
        let DriveOutput { command_nm, assist_gain, state, .. } = *computed;
        let damped_at_ns = self.damped_at_ns;
        let record = DriveTick { torque_nm: command_nm, assist_gain, state, damped_at_ns, ..*record };
        // The group has no members: only a recorder sees it.
        let _ = context.send(Tid::group(TICKS), &record);
    }
}
