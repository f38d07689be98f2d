//! The core of a drive as an application under test, for `sinew play --check`.

use exoskeleton_model::joint::Joint;
use exoskeleton_model::message::{DriveTick, GaitState, JointSample};
use sinew::app::Raw;
use sinew::prelude::*;

use super::drive::{DriveReplay, is_at_rest};
use super::inputs::DriveInputs;
use super::{BEHIND_NS, TickResult};

/// A drive without a timer and without a device: it computes its recorded ticks again, and sends them.
///
/// A tick at rest of which the recording lacks the inputs is sent as it was recorded. Another one is not sent, so that
/// the check reports it as missing.
#[derive(Debug)]
pub struct ReplayedDrive {
    replay: DriveReplay,
    inputs: DriveInputs,
    ticks: Tid,
    is_gap_reported: bool,
}

/// Declares the drive of this name and joint, which sends its ticks to the group `ticks`. It computes them with the
/// recorded gains, multiplied by `gain_factor`. The check must deliver its recorded ticks to it: `--turns
/// exo.drive_tick`, or [`Replay::turns`](sinew::replay::Replay::turns).
#[must_use]
pub fn spec(name: String, ticks: Tid, joint: Joint, gain_factor: f64) -> AppSpec<ReplayedDrive> {
    let drive = move || ReplayedDrive {
        replay: DriveReplay::new(joint, gain_factor),
        inputs: DriveInputs::default(),
        ticks,
        is_gap_reported: false,
    };
    // Gait states are sealed for a guard of the recorded run.
    AppSpec::new(name, drive).handles::<JointSample>().handles::<DriveTick>().handles_raw(GaitState::KIND)
}

impl ReplayedDrive {
    fn compute(&mut self, tick: &DriveTick, context: &AppContext<Self>) {
        let result = match self.replay.compute(tick, Some(&self.inputs)) {
            Some(result) => result,
            None if is_at_rest(tick) => TickResult::of(tick),
            None => {
                self.report_gap(tick);
                return;
            }
        };
        let TickResult { torque_nm, assist_gain, state } = result;
        let computed = DriveTick { torque_nm, assist_gain, state, ..*tick };
        if let Err(error) = context.send(self.ticks, &computed) {
            tracing::error!(tick = tick.seq, %error, "a tick cannot be sent");
        }
    }

    fn report_gap(&mut self, tick: &DriveTick) {
        if !std::mem::replace(&mut self.is_gap_reported, true) {
            let why = self.replay.gap().map_or("its inputs are unknown", String::as_str);
            tracing::warn!(
                tick = tick.seq,
                why,
                "this tick cannot be computed again; `exoskeleton --replay` leaves such ticks out"
            );
        }
    }
}

impl Actor for ReplayedDrive {
    type Context = AppContext<Self>;
}

impl Handler<Delivery<JointSample>> for ReplayedDrive {
    type Result = ();

    fn handle(&mut self, sample: Delivery<JointSample>, _: &mut Self::Context) {
        self.inputs.keep_sample(sample.payload);
    }
}

impl Handler<Delivery<Raw>> for ReplayedDrive {
    type Result = ();

    fn handle(&mut self, gait: Delivery<Raw>, context: &mut Self::Context) {
        self.inputs.keep_gait((gait.source, context.tid()), &gait.payload.0);
    }
}

impl Handler<Delivery<DriveTick>> for ReplayedDrive {
    type Result = ();

    fn handle(&mut self, tick: Delivery<DriveTick>, context: &mut Self::Context) {
        // The record of an input may be later than that of the tick which has used it.
        context.after(Duration::from_nanos(BEHIND_NS), move |drive, _, context| {
            drive.compute(&tick.payload, context);
        });
    }
}
