//! The application `X.drive`: the shell around [`DriveCore`].
//!
//! It starts when its own sensor is ready, even if all other parts are missing: a new instance of a drive
//! that failed can then ramp the torque that its device still holds to zero. It is ready when it also
//! receives from central's gait, which sends only when all three sensors do. Until then, and until walking is
//! released, the torque is zero. Inputs carry the time of sending, in this host's clock ([`Delivery::sent`]).
//!
//! Silence of an input is detected twice, independently. The core rejects an input that is older than 10 ms
//! in the tick that would use it; the runtime's input watchdogs record the silence.
//!
//! Commands of central are protected end to end, by `PROTECTION` of [`GaitState`]. A guard accepts those that
//! are from central, complete, in order and young; otherwise it shuts. When it shuts, a dedicated thread at
//! once orders the device to damp by itself. That works also when this application hangs, or the thread on
//! which it runs. Another thread repeats the order, as it may be lost. A device still needs a watchdog of its
//! own: both threads end, or stop, with the process.
//!
//! Torque goes to the device through the open guard, or is being ramped to zero. A shut guard stays shut
//! until central's gait requests otherwise ([`Arm`]), in a state in which central's commands cause no torque.
//! When the drive is ordered to stop, it ramps the torque to zero first.
//!
//! Its gains are parameters: `sinew param` sets them while the leg walks.

mod anomaly;
mod burden;
mod command;
mod damping_repeater;
mod e_stop;
mod gains;
mod order;
mod tick_record;

use std::io;
use std::path::PathBuf;
use std::sync::Arc;

use exoskeleton_model::control::drive::{DriveConfig, DriveCore, DriveOutput};
use exoskeleton_model::joint::Joint;
use exoskeleton_model::message::{DriveState, GaitMode, GaitState, JointSample, TorqueSet};
use sinew::prelude::*;
use sinew::protection::Guard;
use sinew::supervision::ReadyGate;
use sinew::time::Clock;

use self::command::{Armed, CentralCommands, Output};
use self::damping_repeater::{DampingRepeater, RepeaterHandle};
use self::gains::{AnkleGains, DriveGains, HipGains, KneeGains};
use self::order::Order;
use super::device::{Damper, DriveCommand, JointDevice};
use super::edges::{
    AS_LONG_AS_IT_TAKES, Addressee, Arm, EmergencyStop, GAIT, Reset, STATUS, STOP, Shut, drive_name,
    sensor_name, sent,
};
use super::figures::LoopFigures;
use super::sensor::DeviceMaker;
use super::trace::{DriveRow, EventRow, Trace};
use super::{PERIOD, slots};

pub use self::burden::Burden;

/// Silence of an input that is detected, and the maximum age of a request to open the guard.
const SILENCE_MAX: Duration = Duration::from_millis(10);
/// Ticks between two statuses for central: 200 a second, for its watch over the drives.
const STATUS_TICKS: u64 = 5;
/// Ticks between two statuses for the group `exo.status`: 20 a second, for people. Each wakes a thread of
/// each receiver.
const SHOWN_TICKS: u64 = 50;

/// The constructor arguments of a drive, the same for each incarnation.
#[derive(Clone)]
pub struct DriveParts {
    /// The joint.
    pub joint: Joint,
    /// Creates the connection to its device.
    pub device: DeviceMaker,
    /// Its slot in each period: see [`slots`].
    pub slot: Duration,
    /// Trace of its ticks.
    pub trace: Trace<DriveRow>,
    /// Trace of single events.
    pub events: Trace<EventRow>,
    /// File for its figures at its end, as JSON.
    pub figures: Option<PathBuf>,
    /// CPU time that it wastes in each tick once the person walks: an injected fault, see [`Burden`].
    pub burden: Option<Burden>,
    /// Whether it sends each tick to the group `exo.ticks`, for a recording that can be replayed.
    pub sends_ticks: bool,
}

/// The drive of one joint.
pub struct Drive {
    parts: DriveParts,
    core: DriveCore,
    /// The parameters of the core.
    gains: Arc<dyn DriveGains>,
    device: Box<dyn JointDevice>,
    damper: Box<dyn Damper>,
    sample: Option<JointSample>,
    /// Central's commands, for as long as the present incarnation of central is known.
    commands: Option<CentralCommands>,
    /// Whether this drive's last order was a torque: the device may hold it until the next order.
    gives: bool,
    /// When the device was ordered to damp in this tick, ns.
    damped_at_ns: Option<u64>,
    /// Repeats the order to damp when this thread does not; created before any torque of central's commands.
    repeater: Option<DampingRepeater>,
    /// Whether it was reported that central's commands cannot be guarded.
    unguarded: bool,
    /// Whether this incarnation has received from central.
    has_central_input: bool,
    ticked_at: Option<Time>,
    figures: LoopFigures,
    stopping: bool,
    /// Time of central's first request to walk, for its burden.
    walks_since: Option<Time>,
    /// The only accepted senders of the inputs.
    sensor: Addressee,
    central: Addressee,
    /// Reached when all inputs have arrived for the first time.
    ready: Option<ReadyGate>,
}

/// Declares the drive of a joint.
#[must_use]
pub fn spec(parts: DriveParts, place: Place) -> AppSpec<Drive> {
    match parts.joint {
        Joint::Hip => spec_with(parts, place, &HipGains::new()),
        Joint::Knee => spec_with(parts, place, &KneeGains::new()),
        Joint::Ankle => spec_with(parts, place, &AnkleGains::new()),
    }
}

fn spec_with<G: DriveGains>(parts: DriveParts, place: Place, gains: &Arc<G>) -> AppSpec<Drive> {
    let (sensor, shared) = (sensor_name(parts.joint), gains.clone());
    AppSpec::new(drive_name(parts.joint), move || Drive::new(parts.clone(), shared.clone()))
        .params(gains)
        .handles::<JointSample>()
        .handles::<GaitState>()
        .handles::<TorqueSet>()
        .handles::<Arm>()
        .handles::<EmergencyStop>()
        .handles::<Reset>()
        .requires([sensor])
        .contract(command::contract())
        .start_within(AS_LONG_AS_IT_TAKES)
        .place(place)
}

impl Drive {
    fn new(parts: DriveParts, gains: Arc<dyn DriveGains>) -> Self {
        let device = (parts.device)();
        Self {
            core: DriveCore::new(DriveConfig::standard(parts.joint)),
            gains,
            damper: device.damper(),
            device,
            sensor: Addressee::new(sensor_name(parts.joint)),
            central: Addressee::new(GAIT.to_owned()),
            ready: None,
            parts,
            sample: None,
            commands: None,
            gives: false,
            damped_at_ns: None,
            repeater: None,
            unguarded: false,
            has_central_input: false,
            ticked_at: None,
            figures: LoopFigures::default(),
            stopping: false,
            walks_since: None,
        }
    }

    fn tick(&mut self, tick: Tick, context: &mut AppContext<Self>) {
        let now = context.now();
        let gait = self.newest_command(now, context);
        // Central is known, but its commands do not count.
        let is_shut = self.commands.as_ref().is_some_and(CentralCommands::is_shut);
        if is_shut {
            self.core.distrust_gait();
        }
        self.obey_stop(now);
        if let Some(Err(error)) = self.commands.as_mut().map(|commands| commands.poll(context)) {
            self.report_unguarded(&error);
        }
        let gains = self.gains.get();
        self.core.set_gains(gains);
        let record = self.tick_record(now, tick, (gait.as_ref(), is_shut), gains);
        let computed = self.core.tick(now.as_nanos(), self.sample.as_ref(), gait.as_ref());
        self.damped_at_ns = None;
        let command_nm = self.command(context.clock(), now, &computed, gait.as_ref());
        let output = DriveOutput { command_nm, ..computed };
        if let Some(record) = record {
            self.send_record(&record, &computed, context);
        }
        self.carry_burden(now, gait.as_ref());
        if output.state != DriveState::Init
            && let Some(gate) = self.ready.take()
        {
            tracing::info!(joint = %self.parts.joint, "all inputs have arrived: the drive is ready");
            gate.reached();
        }
        self.note(now, tick, &output);
        if tick.number.is_multiple_of(STATUS_TICKS) {
            let status = self.core.status(now.as_nanos());
            if tick.number.is_multiple_of(SHOWN_TICKS) {
                // There may be no receiver.
                let _ = context.send(Tid::group(STATUS), &status);
            }
            if let Some(central) = self.central.at(now, context) {
                let _ = context.send(central, &status);
            }
            self.ask_to_be_armed(context);
        }
        if self.stopping && output.command_nm.is_none_or(|torque_nm| torque_nm == 0.0) {
            if output.command_nm.is_none() {
                // No reading has arrived: the device may still hold a torque, from an earlier incarnation of
                // this drive.
                self.damper.damp(now, output.state);
            }
            context.stop();
        }
    }

    fn carry_burden(&mut self, now: Time, gait: Option<&GaitState>) {
        let Some(burden) = self.parts.burden else { return };
        let walks = gait.is_some_and(|gait| matches!(gait.mode, GaitMode::Sync | GaitMode::Walk));
        let since = self.walks_since.or_else(|| walks.then_some(now));
        self.walks_since = since;
        if since.is_some_and(|since| now.since(since) > burden::FREE) {
            burden.carry();
        }
    }

    /// Returns central's newest command if it is good. Creates the guard as soon as central is known.
    fn newest_command(&mut self, now: Time, context: &mut AppContext<Self>) -> Option<GaitState> {
        let central = self.central.at(now, context)?;
        if self.commands.as_ref().is_none_or(|commands| commands.central != central) {
            // Commands of an earlier incarnation of central do not count any more.
            self.commands = None;
            match self.guard(central, context) {
                Ok(guard) => self.commands = Some(CentralCommands::new(central, guard)),
                Err(error) => self.report_unguarded(&error),
            }
        }
        self.commands.as_ref()?.guard.apply(|output| output.command).ok().flatten()
    }

    /// Reports once that there is no guard; its creation is retried in the next tick.
    fn report_unguarded(&mut self, error: &io::Error) {
        if !std::mem::replace(&mut self.unguarded, true) {
            let joint = self.parts.joint;
            tracing::error!(%joint, %error, "central's commands cannot be guarded: no torque comes of it");
        }
    }

    /// The only access to the device for assisting torques, with the thread that repeats the order to damp.
    fn guard(&mut self, central: Tid, context: &mut AppContext<Self>) -> io::Result<Guard<Output>> {
        let repeater = match self.repeater.take() {
            Some(repeater) => repeater,
            None => DampingRepeater::start(self.device.damper())?,
        };
        let again = self.repeater.insert(repeater).handle().clone();
        let output = Output::new(self.device.damper(), again, context.clock().clone());
        context.guard::<GaitState, _>(central, output, |output, _| output.make_safe())
    }

    /// Sends the device its order, and returns the torque, Nm; `None` if the device gets no order, or the one
    /// to damp.
    ///
    /// Torques that may assist go through the open guard, so that none follows the order to damp, even if
    /// this thread was delayed before. With a shut guard the device is ordered to damp by itself; a torque
    /// that is being ramped to zero continues while it is young.
    fn command(
        &mut self,
        clock: &Clock,
        now: Time,
        output: &DriveOutput,
        gait: Option<&GaitState>,
    ) -> Option<f64> {
        let released = gait.is_some_and(|gait| !matches!(gait.mode, GaitMode::Hold | GaitMode::Stop));
        let (saturated, state, command_nm) = (output.saturated, output.state, output.command_nm);
        let was_giving = self.gives;
        let Self { commands, device, damper, gives, core, repeater, damped_at_ns, .. } = self;
        let mut send_order = |order| match order {
            Order::Torque(torque_nm) => {
                device.command(now, &DriveCommand { torque_nm, released, saturated, state });
                *gives = torque_nm != 0.0;
                Some(torque_nm)
            }
            Order::Damp => {
                damper.damp(now, state);
                None
            }
            Order::Nothing => None,
        };
        let through = commands.as_ref().map(|commands| {
            commands.guard.apply(|to| {
                let order = Order::through_open(command_nm, to.gives || was_giving);
                if let Order::Torque(torque_nm) = order {
                    to.gives = torque_nm != 0.0;
                    to.again.rests();
                }
                (send_order(order), order)
            })
        });
        if let Some(Ok((given, order))) = through {
            if order == Order::Damp {
                // The order was sent now, not when this tick began.
                core.let_device_damp(*damped_at_ns.insert(clock.now().as_nanos()));
            }
            return given;
        }
        let order = Order::past_shut(state, command_nm, was_giving, clock.now().since(now));
        let again = repeater.as_ref().map(DampingRepeater::handle);
        match order {
            Order::Damp => {
                let given = send_order(order);
                core.let_device_damp(*damped_at_ns.insert(clock.now().as_nanos()));
                return given;
            }
            Order::Torque(0.0) => again.into_iter().for_each(RepeaterHandle::rests),
            Order::Torque(_) => again.into_iter().for_each(RepeaterHandle::ramps),
            Order::Nothing => {}
        }
        send_order(order)
    }

    /// Reports to central that its commands arrive, but do not count. Central decides whether to open the
    /// guard.
    fn ask_to_be_armed(&self, context: &AppContext<Self>) {
        let Some(commands) = self.commands.as_ref().filter(|commands| commands.is_shut()) else { return };
        // A lost report is followed by the next.
        let _ = context.send(commands.central, &Shut { suspect: commands.is_suspect() });
    }

    fn note(&mut self, now: Time, tick: Tick, output: &DriveOutput) {
        let counters = self.core.counters();
        let refused = counters.commands_refused;
        let row = DriveRow {
            t_ns: now.as_nanos(),
            late_us: micros(tick.lateness),
            period_us: self.ticked_at.map_or(0, |at| micros(now.since(at))),
            sample_age_us: output.sample_age_ns.map(|ns| micros(Duration::from_nanos(ns))),
            gait_age_us: output.gait_age_ns.map(|ns| micros(Duration::from_nanos(ns))),
            state: output.state,
            torque_nm: output.command_nm,
            assist_gain: output.assist_gain,
            faults: self.core.faults().0,
            commands_taken: counters.commands_admitted,
            refused_not_finite: refused.not_finite,
            refused_out_of_range: refused.out_of_range,
            refused_old: refused.old_sequence + refused.too_old,
            refused_opposed: refused.opposed,
        };
        self.ticked_at = Some(now);
        self.figures.note(&row);
        self.parts.trace.note(row);
    }

    fn note_silence(&self, input: &str, silence: InputTimeout) {
        let (joint, silent) = (self.parts.joint, silence.silent);
        tracing::warn!(%joint, input, ?silent, age = ?silence.age, lateness = ?silence.lateness, "an input is silent");
        self.parts.events.event("input_silent", input, format!("nothing for {silent:?}"));
    }

    fn report_figures(&self) {
        let (joint, counters, summary) = (self.parts.joint, *self.core.counters(), self.figures.summary());
        tracing::info!(
            %joint,
            ticks = summary.ticks,
            period_p999_us = summary.period_us.p999,
            gait_age_p999_us = summary.gait_age_us.p999,
            deadline_misses = summary.deadline_misses,
            safe_entries = counters.safe_entries,
            samples_refused = counters.samples_refused.total(),
            gait_refused = counters.gait_refused.total(),
            commands_refused = ?counters.commands_refused,
            pauses = counters.pauses,
            "the drive ends"
        );
        let Some(path) = &self.parts.figures else { return };
        let json = serde_json::to_vec_pretty(&summary).map_err(io::Error::other);
        if let Err(error) = json.and_then(|json| std::fs::write(path, json)) {
            tracing::error!(path = %path.display(), %error, "the figures cannot be written");
        }
    }
}

/// Whole microseconds; saturates at about 71 minutes.
pub(super) fn micros(time: Duration) -> u32 {
    u32::try_from(time.as_micros()).unwrap_or(u32::MAX)
}

impl Actor for Drive {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        self.ready = context.hold_ready();
        context.join(STOP);
        context.every_from(slots::next(context.now(), self.parts.slot), PERIOD, Self::tick);
    }

    fn stopping(&mut self, _: &mut Self::Context) -> Running {
        if self.stopping {
            return Running::Stop;
        }
        self.stopping = true;
        self.core.let_go();
        // The ticks go on until the torque is zero.
        Running::Continue
    }

    fn stopped(&mut self, _: &mut Self::Context) {
        self.report_figures();
    }
}

impl Handler<Delivery<JointSample>> for Drive {
    type Result = ();

    fn handle(&mut self, sample: Delivery<JointSample>, context: &mut Self::Context) {
        if self.sensor.at(context.now(), context) != Some(sample.source) {
            context.reject();
            return;
        }
        if self.sample.is_none() {
            // From the first one on: before it there is no silence to detect.
            context.watch_input::<JointSample>(None, SILENCE_MAX, |this, silence, _| {
                this.note_silence("joint sample", silence);
            });
        }
        let (t_ns, t_error_ns) = sent(&sample, sample.t_ns);
        self.sample = Some(JointSample { t_ns, t_error_ns, ..sample.payload });
    }
}

impl Handler<Delivery<GaitState>> for Drive {
    type Result = ();

    fn handle(&mut self, gait: Delivery<GaitState>, context: &mut Self::Context) {
        // Commands that are not from central, damaged, old, repeated or out of order do not arrive here.
        let Some(commands) = self.commands.as_ref().filter(|commands| commands.central == gait.source) else {
            context.reject();
            return;
        };
        let (t_ns, t_error_ns) = sent(&gait, gait.t_ns);
        let gait = GaitState { t_ns, t_error_ns, ..gait.payload };
        if commands.guard.apply(|output| output.command = Some(gait)).is_err() {
            context.reject();
            return;
        }
        if !std::mem::replace(&mut self.has_central_input, true) {
            context.watch_input::<GaitState>(None, SILENCE_MAX, |this, silence, _| {
                this.note_silence("gait state", silence);
            });
        }
    }
}

impl Handler<Delivery<TorqueSet>> for Drive {
    type Result = ();

    fn handle(&mut self, command: Delivery<TorqueSet>, context: &mut Self::Context) {
        let now = context.now();
        let central = self.central.at(now, context);
        if central.map(|central| central.node) != Some(command.source.node) {
            context.reject();
            return;
        }
        let (t_ns, t_error_ns) = sent(&command, command.t_ns);
        let set = TorqueSet { t_ns, t_error_ns, ..command.payload };
        if !self.core.command(now.as_nanos(), &set) {
            context.reject();
        }
    }
}

impl Handler<Delivery<Arm>> for Drive {
    type Result = ();

    fn handle(&mut self, arm: Delivery<Arm>, context: &mut Self::Context) {
        let state = self.core.state();
        let Some(commands) = self.commands.as_mut().filter(|commands| commands.central == arm.source) else {
            context.reject();
            return;
        };
        match commands.arm(&arm, state) {
            Armed::Now => {}
            Armed::Before => return,
            Armed::Refused => {
                context.reject();
                return;
            }
        }
        self.parts.events.event("armed", &arm.source.to_string(), String::new());
    }
}
