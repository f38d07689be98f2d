//! The application `central.gait`: the shell around [`CentralCore`].
//!
//! It starts when the three sensors are ready, and is ready itself when all inputs are fresh. It detects the
//! loss of a joint in three ways, and the first counts: its samples are older than 10 ms, its node is lost,
//! or its sensor is.

use std::sync::Arc;
use std::sync::atomic::{AtomicU32, Ordering};

use exoskeleton_model::central::{CentralConfig, CentralCore, CentralInput, Resume, bit};
use exoskeleton_model::joint::{Joint, PerJoint};
use exoskeleton_model::message::{DriveStatus, FootLoad, GaitMode, GaitState, JointSample};
use sinew::prelude::*;
use sinew::{NodeAddress, events::Down, supervision::ReadyGate};

use super::drive::micros;
use super::edges::{
    AS_LONG_AS_IT_TAKES, Addressee, Arm, EmergencyStop, GAIT, GaitStatus, Release, Reset, STATUS, STOP, Shut,
    drive_name, joint_of_sensor, sensor_name, sent,
};
use super::trace::{EventRow, GaitRow, Trace};
use super::{PERIOD, slots};

/// Ticks between two statuses: 20 a second.
const STATUS_TICKS: u64 = 50;

/// The constructor arguments of the gait application, the same for each incarnation.
#[derive(Clone)]
pub struct GaitParts {
    /// Addresses of the joint nodes.
    pub joints: PerJoint<NodeAddress>,
    /// Epoch of the next incarnation: begins at the node's incarnation in seconds, so that it grows over
    /// restarts of the node and of the application.
    pub epoch: Arc<AtomicU32>,
    /// Its slot in each period: see [`slots`].
    pub slot: Duration,
    /// Trace of its ticks.
    pub trace: Trace<GaitRow>,
    /// Trace of single events.
    pub events: Trace<EventRow>,
    /// How it continues after a loss.
    pub resume: Resume,
}

/// The signs that a joint is lost.
#[derive(Debug, Clone, Copy, Default)]
struct Gone {
    node: bool,
    sensor: bool,
}

/// The gait application.
pub struct Gait {
    parts: GaitParts,
    core: CentralCore,
    /// The receivers of the gait, one by one: commands that move a joint are protected from here to its
    /// drive.
    drives: PerJoint<Addressee>,
    /// The last command to them.
    mode: Option<GaitMode>,
    samples: PerJoint<Option<JointSample>>,
    load: Option<FootLoad>,
    gone: PerJoint<Gone>,
    ready: Option<ReadyGate>,
    late_max: Duration,
    /// Joints that were flagged as degraded last.
    degraded: u8,
    /// Joints with a monitor on their drive.
    monitored: PerJoint<bool>,
}

/// Declares the gait application.
#[must_use]
pub fn spec(parts: GaitParts, place: Place) -> AppSpec<Gait> {
    AppSpec::new(GAIT, move || Gait::new(parts.clone()))
        .handles::<JointSample>()
        .handles::<FootLoad>()
        .handles::<DriveStatus>()
        .handles::<Shut>()
        .handles::<Down>()
        .handles::<Release>()
        .handles::<EmergencyStop>()
        .handles::<Reset>()
        .handles::<NodeEvent>()
        .handles::<RequirementEvent>()
        .requires(Joint::ALL.map(sensor_name))
        .start_within(AS_LONG_AS_IT_TAKES)
        .place(place)
}

impl Gait {
    fn new(parts: GaitParts) -> Self {
        // Only its growth matters.
        let epoch = parts.epoch.fetch_add(1, Ordering::Relaxed);
        let config = CentralConfig { epoch, resume: parts.resume, ..CentralConfig::default() };
        Self {
            core: CentralCore::new(config),
            parts,
            drives: Joint::ALL.map(|joint| Addressee::new(drive_name(joint))),
            mode: None,
            samples: [None; 3],
            load: None,
            gone: [Gone::default(); 3],
            ready: None,
            late_max: Duration::ZERO,
            degraded: 0,
            monitored: [false; 3],
        }
    }

    fn tick(&mut self, tick: Tick, context: &AppContext<Self>) {
        let now = context.now();
        let input =
            CentralInput { samples: self.samples.each_ref().map(Option::as_ref), load: self.load.as_ref() };
        let state = self.core.tick(now.as_nanos(), &input);
        self.mode = state.map(|state| state.mode);
        if let Some(state) = &state {
            for drive in &mut self.drives {
                if let Some(drive) = drive.at(now, context) {
                    // A drive that cannot be reached receives nothing, and stops assisting by itself.
                    let _ = context.send(drive, state);
                }
            }
            if let Some(gate) = self.ready.take() {
                gate.reached();
            }
        }
        self.flag_degraded();
        self.note(now, tick, state.as_ref());
        self.late_max = self.late_max.max(tick.lateness);
        if tick.number.is_multiple_of(STATUS_TICKS) {
            let status = self.status(state.as_ref());
            let _ = context.send(Tid::group(STATUS), &status);
        }
    }

    fn note(&self, now: Time, tick: Tick, state: Option<&GaitState>) {
        self.parts.trace.note(GaitRow {
            t_ns: now.as_nanos(),
            late_us: micros(tick.lateness),
            phase: state.map_or(0.0, |state| state.phase),
            confidence: state.map_or(0.0, |state| state.confidence),
            mode: state.map(|state| state.mode),
            degraded: self.degraded,
        });
    }

    fn status(&mut self, state: Option<&GaitState>) -> GaitStatus {
        GaitStatus {
            phase: state.map_or(0.0, |state| state.phase),
            confidence: state.map_or(0.0, |state| state.confidence),
            mode: state.map(|state| state.mode),
            degraded: self.degraded,
            late_max_us: micros(std::mem::take(&mut self.late_max)),
        }
    }

    /// Reports once that a joint walks without its drive's help, and once that this has ended.
    fn flag_degraded(&mut self) {
        let degraded = self.core.degraded();
        let changed = std::mem::replace(&mut self.degraded, degraded) ^ degraded;
        for joint in Joint::ALL.into_iter().filter(|joint| changed & bit(*joint) != 0) {
            let what = if degraded & bit(joint) != 0 { "degraded" } else { "assisted_again" };
            tracing::warn!(%joint, what, "a drive that is asked to assist changes");
            self.parts.events.event(what, joint.name(), String::new());
        }
    }

    fn joint_at(&self, node: NodeAddress) -> Option<Joint> {
        Joint::ALL.into_iter().find(|joint| self.parts.joints[joint.index()] == node)
    }

    fn learn(&mut self, joint: Joint, change: impl FnOnce(&mut Gone)) {
        let gone = &mut self.gone[joint.index()];
        change(gone);
        if gone.node || gone.sensor {
            self.core.node_lost(joint);
        } else {
            self.core.node_found(joint);
        }
    }
}

impl Actor for Gait {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        tracing::info!("the barrier is open: central's gait starts");
        self.ready = context.hold_ready();
        context.join(STOP);
        let first = slots::next(context.now(), self.parts.slot);
        context.every_from(first, PERIOD, |this, tick, context| this.tick(tick, context));
    }
}

impl Handler<Delivery<JointSample>> for Gait {
    type Result = ();

    fn handle(&mut self, sample: Delivery<JointSample>, context: &mut Self::Context) {
        match self.joint_at(sample.source.node) {
            Some(joint) => {
                let (t_ns, t_error_ns) = sent(&sample, sample.t_ns);
                let sample = JointSample { t_ns, t_error_ns, ..sample.payload };
                self.samples[joint.index()] = Some(sample);
            }
            None => context.reject(),
        }
    }
}

impl Handler<Delivery<FootLoad>> for Gait {
    type Result = ();

    fn handle(&mut self, load: Delivery<FootLoad>, context: &mut Self::Context) {
        if self.joint_at(load.source.node) == Some(Joint::Ankle) {
            let (t_ns, t_error_ns) = sent(&load, load.t_ns);
            self.load = Some(FootLoad { t_ns, t_error_ns, ..load.payload });
        } else {
            context.reject();
        }
    }
}

impl Handler<Delivery<Release>> for Gait {
    type Result = ();

    fn handle(&mut self, release: Delivery<Release>, context: &mut Self::Context) {
        // Only from an application on central itself.
        if release.source.node != context.tid().node {
            context.reject();
            return;
        }
        match self.core.release() {
            Ok(()) => tracing::info!(by = %release.source, "walking is released"),
            Err(refusal) => {
                tracing::warn!(by = %release.source, %refusal, "walking is not released");
                context.reject();
            }
        }
    }
}

impl Handler<Delivery<EmergencyStop>> for Gait {
    type Result = ();

    fn handle(&mut self, stop: Delivery<EmergencyStop>, _: &mut Self::Context) {
        // Accepted from any sender: stopping needs no permission.
        tracing::warn!(by = %stop.source, "the e-stop was pressed");
        self.core.stop();
        self.parts.events.event("e_stop", &stop.source.to_string(), String::new());
    }
}

impl Handler<Delivery<Reset>> for Gait {
    type Result = ();

    fn handle(&mut self, reset: Delivery<Reset>, context: &mut Self::Context) {
        // Only from an application on central itself.
        if reset.source.node != context.tid().node {
            context.reject();
            return;
        }
        tracing::info!(by = %reset.source, "the e-stop is taken back");
        self.core.reset();
        self.parts.events.event("reset", &reset.source.to_string(), String::new());
    }
}

impl Handler<Delivery<DriveStatus>> for Gait {
    type Result = ();

    fn handle(&mut self, status: Delivery<DriveStatus>, context: &mut Self::Context) {
        match self.joint_at(status.source.node) {
            Some(joint) => {
                let monitored = &mut self.monitored[joint.index()];
                // Without a monitor its silence is detected all the same, 25 ms later.
                *monitored = *monitored || context.monitor(status.source).is_ok();
                let (t_ns, t_error_ns) = sent(&status, status.t_ns);
                let status = DriveStatus { t_ns, t_error_ns, ..status.payload };
                self.core.on_drive_status(context.now().as_nanos(), joint, &status);
            }
            None => context.reject(),
        }
    }
}

/// Whether a drive may accept central's commands again. While a part is missing it has to wait for the
/// outcome of that. A drive with manipulated commands waits until the leg is held, after which walking is
/// released again.
const fn may_arm(mode: Option<GaitMode>, suspect: bool) -> bool {
    match mode {
        // These commands cause no torque.
        Some(GaitMode::Hold | GaitMode::Stop) => true,
        // Walking is released: commands were late or lost, or the drive is a new one.
        Some(GaitMode::Sync | GaitMode::Walk) => !suspect,
        Some(GaitMode::Safe) | None => false,
    }
}

impl Handler<Delivery<Shut>> for Gait {
    type Result = ();

    fn handle(&mut self, shut: Delivery<Shut>, context: &mut Self::Context) {
        let Some(joint) = self.joint_at(shut.source.node) else {
            context.reject();
            return;
        };
        if self.drives[joint.index()].at(context.now(), context) != Some(shut.source) {
            context.reject();
        } else if may_arm(self.mode, shut.suspect) {
            // A drive that cannot be reached asks again.
            let _ = context.send(shut.source, &Arm { suspect: shut.suspect });
        }
    }
}

impl Handler<Delivery<Down>> for Gait {
    type Result = ();

    fn handle(&mut self, down: Delivery<Down>, context: &mut Self::Context) {
        let Some(joint) = self.joint_at(down.payload.tid.node) else { return };
        tracing::warn!(%joint, why = %down.payload, "a drive has ended");
        // The next incarnation is monitored from its first message on.
        self.monitored[joint.index()] = false;
        self.core.drive_ended(joint, context.now().as_nanos());
    }
}

impl Handler<Delivery<NodeEvent>> for Gait {
    type Result = ();

    fn handle(&mut self, event: Delivery<NodeEvent>, _: &mut Self::Context) {
        let (node, is_gone) = match event.payload {
            NodeEvent::NodeLost { node, .. } => (node, true),
            NodeEvent::NodeFound { node, .. } | NodeEvent::NodeRestarted { node, .. } => (node, false),
            // Its drives' own watchdogs, and the requirements, report the effect on the gait sooner.
            NodeEvent::AppStalled { .. } | NodeEvent::AppResumed { .. } => return,
        };
        if let Some(joint) = self.joint_at(node) {
            self.learn(joint, |gone| gone.node = is_gone);
        }
    }
}

impl Handler<Delivery<RequirementEvent>> for Gait {
    type Result = ();

    fn handle(&mut self, event: Delivery<RequirementEvent>, _: &mut Self::Context) {
        let Some(joint) = joint_of_sensor(event.name()) else { return };
        let is_gone = match event.payload {
            RequirementEvent::Lost { .. } | RequirementEvent::Without { .. } => true,
            RequirementEvent::Met { .. } => false,
        };
        self.learn(joint, |gone| gone.sensor = is_gone);
    }
}

#[cfg(test)]
#[path = "../../tests/unit/gait.rs"]
mod tests;
