//! The application `X.sensor`: reads the device each millisecond and sends the sample to its own drive and to
//! central.
//!
//! It is ready when the first reading has arrived and its node is not held any more: no output of a node can be armed
//! before that, and the parts of the robot get ready together. A reading is sent once, never again with a newer stamp:
//! when the device falls silent so does the sensor, and its receivers watch for silence.

use std::sync::Arc;

use exoskeleton_model::joint::Joint;
use exoskeleton_model::message::{FootLoad, JointSample};
use exoskeleton_model::sensor::{SensorConfig, SensorCore};
use sinew::prelude::*;
use sinew::stop::{AskStop, StopReport, StopState};
use sinew::supervision::ReadyGate;

use super::device::JointDevice;
use super::edges::{AS_LONG_AS_IT_TAKES, Addressee, GAIT, drive_name, sensor_name};
use super::trace::{EventRow, Trace};
use super::{PERIOD, slots};

/// Silence of the device that is logged.
const SILENCE_MAX: Duration = Duration::from_millis(10);

/// Creates the connection to a joint's device, for each incarnation of an application.
pub type DeviceMaker = Arc<dyn Fn() -> Box<dyn JointDevice> + Send + Sync>;

/// A tick that is later than this is recorded, to explain why samples were old.
const LATE_MAX: Duration = Duration::from_millis(5);
/// Interval between two looks at the stop of the node, while it is held at its start.
const LOOK_AT_STOP: Duration = Duration::from_millis(10);
/// Time limit of the answer.
const ASK_WITHIN: Duration = Duration::from_secs(1);
/// Name of that record.
pub const SENSOR_LATE: &str = "sensor_late";

/// The sensor of one joint.
pub struct Sensor {
    joint: Joint,
    slot: Duration,
    core: SensorCore,
    device: Box<dyn JointDevice>,
    drive: Addressee,
    gait: Addressee,
    ready: Option<ReadyGate>,
    /// Whether the node may be held since its start.
    is_held: bool,
    read_at: Option<Time>,
    silent: bool,
    events: Trace<EventRow>,
}

/// Declares the sensor of `joint`, with its slot in each period: see [`slots`].
#[must_use]
pub fn spec(
    joint: Joint,
    device: DeviceMaker,
    slot: Duration,
    events: Trace<EventRow>,
    place: Place,
) -> AppSpec<Sensor> {
    AppSpec::new(sensor_name(joint), move || Sensor::new(joint, device(), slot, events.clone()))
        .start_within(AS_LONG_AS_IT_TAKES)
        .place(place)
}

impl Sensor {
    fn new(joint: Joint, device: Box<dyn JointDevice>, slot: Duration, events: Trace<EventRow>) -> Self {
        Self {
            joint,
            slot,
            core: SensorCore::new(SensorConfig::default()),
            device,
            drive: Addressee::new(drive_name(joint)),
            gait: Addressee::new(GAIT.to_owned()),
            ready: None,
            is_held: true,
            read_at: None,
            silent: false,
            events,
        }
    }

    fn tick(&mut self, tick: Tick, context: &AppContext<Self>) {
        let now = context.now();
        if tick.lateness > LATE_MAX {
            self.events.event(SENSOR_LATE, self.joint.name(), format!("{:?}", tick.lateness));
        }
        let Some(reading) = self.device.read_newest(now) else {
            self.judge_silence(now);
            return;
        };
        self.read_at = Some(now);
        self.silent = false;
        let t_ns = now.as_nanos();
        let sample = self.core.sample(t_ns, &reading.device);
        let load = reading.foot.map(|foot| self.core.foot_load(t_ns, &foot));
        self.send_sample(now, &sample, load.as_ref(), context);
        if !self.is_held
            && let Some(gate) = self.ready.take()
        {
            gate.reached();
        }
    }

    /// Asks the node until it is not held. Without an answer the sensor does not wait: in virtual time there is no
    /// node.
    fn look_at_stop(&mut self, context: &mut AppContext<Self>) {
        let stop = Tid::new(context.tid().node, AppAddress::STOP);
        match context.message(stop, &AskStop {}).ask::<StopReport>(ASK_WITHIN) {
            Ok(answer) => drop(context.spawn(answer.into_actor(self).map(|answer, this, context| {
                this.is_held = answer.is_ok_and(|report| report.state == StopState::Held);
                if this.is_held {
                    context.run_later(LOOK_AT_STOP, Self::look_at_stop);
                }
            }))),
            Err(_) => self.is_held = false,
        }
    }

    /// Sends to the receivers that can be reached now; both detect silence.
    fn send_sample(
        &mut self,
        now: Time,
        sample: &JointSample,
        load: Option<&FootLoad>,
        context: &AppContext<Self>,
    ) {
        if let Some(drive) = self.drive.at(now, context) {
            let _ = context.send(drive, sample);
        }
        let Some(gait) = self.gait.at(now, context) else { return };
        let _ = context.send(gait, sample);
        if let Some(load) = load {
            let _ = context.send(gait, load);
        }
    }

    fn judge_silence(&mut self, now: Time) {
        let lasts = self.read_at.is_some_and(|at| now.since(at) > SILENCE_MAX);
        if lasts && !self.silent {
            self.silent = true;
            tracing::warn!(joint = %self.joint, "the device is silent; so is its sensor");
        }
    }
}

impl Actor for Sensor {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        self.ready = context.hold_ready();
        self.look_at_stop(context);
        let first = slots::next(context.now(), self.slot);
        context.every_from(first, PERIOD, |this, tick, context| this.tick(tick, context));
    }
}
