//! The application `X.drive`: the shell around [`DriveCore`].
//!
//! It starts when its own sensor is ready, so that a new instance of a drive that failed can bring the torque that its
//! device still holds to zero, whoever else is missing. It is ready when central's gait is heard too, which speaks only
//! when all three sensors do; until then, and until walking is released, the torque is zero. Inputs carry
//! the time at which they were sent, in this host's clock ([`Delivery::sent`]). Silence of an input is noticed twice,
//! independently: by the core, which refuses what is older than 10 ms in the tick in which it would use it, and by the
//! runtime's input watchdogs, which write it down. What central says is protected from end to end, by `PROTECTION` of
//! [`GaitState`]: a guard lets through what is central's, whole, in order and young; else it is shut. When it shuts, the
//! device is told at once to damp by itself, by a thread that is there for that: also when this application hangs, or the
//! thread on which it runs. Another one repeats it, as it may be lost. No device can do without a watchdog of its own for all that: both
//! threads end, or stand still, with the process. Torque goes to the device through the open guard, or is on its way to zero. A shut guard stays
//! so until central's gait asks for it ([`Arm`]), in a state in which no torque comes of central's word. When the drive is told
//! to stop, the torque ramps to zero first.

mod burden;
mod lookout;
mod order;
mod suspicion;
mod word;

use std::io;
use std::path::{Path, PathBuf};

use sinew::prelude::*;
use sinew::protection::Guard;
use sinew::supervision::ReadyGate;

pub use self::burden::Burden;
use self::lookout::{Lookout, Watch};
use self::order::Order;
use self::word::{Armed, Output, Word};
use super::PERIOD;
use super::device::{Damper, DriveCommand, JointDevice};
use super::edges::{
    AS_LONG_AS_IT_TAKES, Addressee, Arm, EmergencyStop, GAIT, Reset, STATUS, STOP, Shut, drive_name,
    sensor_name, sent,
};
use super::figures::LoopFigures;
use super::sensor::DeviceMaker;
use super::trace::{DriveRow, EventRow, Trace};
use crate::control::drive::{DriveConfig, DriveCore, DriveOutput};
use crate::joint::Joint;
use crate::message::{DriveState, GaitMode, GaitState, JointSample, TorqueSet};

/// Silence of an input that is noticed, and the greatest age of what asks for central's word to count.
const SILENCE_MAX: Duration = Duration::from_millis(10);
/// Ticks between two statuses: 200 statuses a second.
const STATUS_TICKS: u64 = 5;

/// What a drive is made with, in each of its lives.
#[derive(Clone)]
pub struct DriveParts {
    /// The joint.
    pub joint: Joint,
    /// The way to its device.
    pub device: DeviceMaker,
    /// Where its ticks go.
    pub trace: Trace<DriveRow>,
    /// Where it writes down what happens once.
    pub events: Trace<EventRow>,
    /// Where it leaves its figures at its end, as JSON.
    pub figures: Option<PathBuf>,
    /// CPU time that it wastes in each tick once the person walks: a planted fault, see [`Burden`].
    pub burden: Option<Burden>,
}

/// The drive of one joint.
pub struct Drive {
    parts: DriveParts,
    core: DriveCore,
    device: Box<dyn JointDevice>,
    damper: Box<dyn Damper>,
    sample: Option<JointSample>,
    /// Central's newest word, for as long as all that comes from there is good.
    word: Option<Word>,
    /// Whether the device was last told a torque by this drive: it may hold that for as long as it is told nothing else.
    gives: bool,
    /// Who repeats the order to damp when this thread does not; there before any torque of central's word.
    lookout: Option<Lookout>,
    /// Whether it was said that central's word cannot be guarded.
    unguarded: bool,
    /// Whether central was heard in this life.
    central_heard: bool,
    ticked_at: Option<Time>,
    figures: LoopFigures,
    stopping: bool,
    /// When central asked for walking first, for its burden.
    walks_since: Option<Time>,
    /// Whom the inputs are believed from.
    sensor: Addressee,
    central: Addressee,
    /// Reached when all inputs are there for the first time.
    ready: Option<ReadyGate>,
}

/// Declares the drive of a joint.
#[must_use]
pub fn spec(parts: DriveParts, place: Place) -> AppSpec<Drive> {
    let sensor = sensor_name(parts.joint);
    AppSpec::new(drive_name(parts.joint), move || Drive::new(parts.clone()))
        .handles::<JointSample>()
        .handles::<GaitState>()
        .handles::<TorqueSet>()
        .handles::<Arm>()
        .handles::<EmergencyStop>()
        .handles::<Reset>()
        .requires([sensor])
        .start_within(AS_LONG_AS_IT_TAKES)
        .place(place)
}

impl Drive {
    fn new(parts: DriveParts) -> Self {
        let device = (parts.device)();
        Self {
            core: DriveCore::new(DriveConfig::standard(parts.joint)),
            damper: device.damper(),
            device,
            sensor: Addressee::new(sensor_name(parts.joint)),
            central: Addressee::new(GAIT.to_owned()),
            ready: None,
            parts,
            sample: None,
            word: None,
            gives: false,
            lookout: None,
            unguarded: false,
            central_heard: false,
            ticked_at: None,
            figures: LoopFigures::default(),
            stopping: false,
            walks_since: None,
        }
    }

    fn tick(&mut self, tick: Tick, context: &mut AppContext<Self>) {
        let now = Time::now();
        let gait = self.word(now, context);
        let is_shut = self.is_shut();
        if is_shut {
            self.core.disbelieve_gait();
        }
        if let Some(Err(error)) = self.word.as_mut().map(|word| word.look(context)) {
            self.tell_unguarded(&error);
        }
        let mut output = self.core.tick(now.as_nanos(), self.sample.as_ref(), gait.as_ref());
        output.command_nm = self.command(now, &output, gait.as_ref());
        self.carry_burden(now, gait.as_ref());
        if output.state != DriveState::Init
            && let Some(gate) = self.ready.take()
        {
            tracing::info!(joint = %self.parts.joint, "all parts are heard: the drive is ready");
            gate.reached();
        }
        self.note(now, tick, &output);
        if tick.number.is_multiple_of(STATUS_TICKS) {
            let status = self.core.status(now.as_nanos());
            // Nobody may want to know.
            let _ = context.send(Tid::group(STATUS), &status);
            if let Some(central) = self.central.at(now, context) {
                let _ = context.send(central, &status);
            }
            self.ask_to_be_armed(context);
        }
        if self.stopping && self.at_rest(&output) {
            if output.command_nm.is_none() {
                // Not heard: it may hold a torque all the same, from an earlier life of this drive.
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

    /// What central says, if that is good. Guarded from the moment on at which it is there.
    fn word(&mut self, now: Time, context: &mut AppContext<Self>) -> Option<GaitState> {
        let central = self.central.at(now, context)?;
        if self.word.as_ref().is_none_or(|word| word.central != central) {
            // What another life of central has said is worth nothing any more.
            self.word = None;
            match self.guard(central, context) {
                Ok(guard) => self.word = Some(Word::new(central, guard)),
                Err(error) => self.tell_unguarded(&error),
            }
        }
        self.word.as_ref()?.guard.apply(|output| output.word).ok().flatten()
    }

    /// Says once that a guard cannot be had; it is tried again in the next tick.
    fn tell_unguarded(&mut self, error: &io::Error) {
        if !std::mem::replace(&mut self.unguarded, true) {
            let joint = self.parts.joint;
            tracing::error!(%joint, %error, "central's word cannot be guarded: no torque comes of it");
        }
    }

    /// The only way to the device for what may assist, with who repeats the order to damp.
    fn guard(&mut self, central: Tid, context: &mut AppContext<Self>) -> io::Result<Guard<Output>> {
        let lookout = match self.lookout.take() {
            Some(lookout) => lookout,
            None => Lookout::start(self.device.damper())?,
        };
        let again = self.lookout.insert(lookout).watch().clone();
        let output = Output::new(self.device.damper(), again);
        context.guard::<GaitState, _>(central, output, |output, _| output.make_safe())
    }

    /// Whether central's word does not count, though it is known whose it is.
    fn is_shut(&self) -> bool {
        self.word.as_ref().is_some_and(Word::is_shut)
    }

    /// Gives the device its command, and returns what it is to give, Nm; `None` when it is told nothing, or to damp by itself.
    ///
    /// What may assist goes through the open guard, so that none follows the order to damp, however long this thread was held up
    /// before it came here. With a shut one the device is left to damp by itself; what is on its way to zero goes on while it is young.
    fn command(&mut self, now: Time, output: &DriveOutput, gait: Option<&GaitState>) -> Option<f64> {
        let released = gait.is_some_and(|gait| !matches!(gait.mode, GaitMode::Hold | GaitMode::Stop));
        let (saturated, state, command_nm) = (output.saturated, output.state, output.command_nm);
        let was_giving = self.gives;
        let Self { word, device, damper, gives, core, lookout, .. } = self;
        let mut tell = |order| match order {
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
        let through = word.as_ref().map(|word| {
            word.guard.apply(|to| {
                let order = Order::through_open(command_nm, to.gives || was_giving);
                if let Order::Torque(torque_nm) = order {
                    to.gives = torque_nm != 0.0;
                    to.again.rests();
                }
                (tell(order), order)
            })
        });
        if let Some(Ok((given, order))) = through {
            if order == Order::Damp {
                // It was told so now, and not when this tick began.
                core.let_device_damp(Time::now().as_nanos());
            }
            return given;
        }
        let order = Order::past_shut(state, command_nm, was_giving, Time::now().since(now));
        let again = lookout.as_ref().map(Lookout::watch);
        match order {
            Order::Damp => {
                let given = tell(order);
                core.let_device_damp(Time::now().as_nanos());
                return given;
            }
            Order::Torque(0.0) => again.into_iter().for_each(Watch::rests),
            Order::Torque(_) => again.into_iter().for_each(Watch::ramps),
            Order::Nothing => {}
        }
        tell(order)
    }

    /// Tells central that its word does not count, though it comes; what becomes of that is central's to say.
    fn ask_to_be_armed(&self, context: &AppContext<Self>) {
        let Some(word) = self.word.as_ref().filter(|word| word.is_shut()) else { return };
        // It is asked again.
        let _ = context.send(word.central, &Shut { suspect: word.is_suspect() });
    }

    fn at_rest(&self, output: &DriveOutput) -> bool {
        output.command_nm.is_none_or(|torque_nm| torque_nm == 0.0)
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

    /// Writes down what happened once, now.
    fn note_event(&self, what: &str, whom: &str, how: String) {
        let (what, whom) = (what.to_owned(), whom.to_owned());
        self.parts.events.note(EventRow { t_ns: Time::now().as_nanos(), what, whom, how });
    }

    fn note_silence(&self, input: &str, silence: InputTimeout) {
        let (joint, silent) = (self.parts.joint, silence.silent);
        tracing::warn!(%joint, input, ?silent, age = ?silence.age, lateness = ?silence.lateness, "an input is silent");
        self.note_event("input_silent", input, format!("nothing for {silent:?}"));
    }

    fn tell_figures(&self) {
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
        if let Some(path) = &self.parts.figures
            && let Err(error) = write_json(path, &summary)
        {
            tracing::error!(path = %path.display(), %error, "the figures cannot be written");
        }
    }
}

fn write_json(path: &Path, value: &impl serde::Serialize) -> io::Result<()> {
    std::fs::write(path, serde_json::to_string_pretty(value).map_err(io::Error::other)?)
}

/// Whole microseconds; more than an hour is an hour and a bit.
pub(super) fn micros(time: Duration) -> u32 {
    u32::try_from(time.as_micros()).unwrap_or(u32::MAX)
}

impl Actor for Drive {
    type Context = AppContext<Self>;

    fn started(&mut self, context: &mut Self::Context) {
        self.ready = context.hold_ready();
        context.join(STOP);
        context.every(PERIOD, Self::tick);
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
        self.tell_figures();
    }
}

impl Handler<Delivery<JointSample>> for Drive {
    type Result = ();

    fn handle(&mut self, sample: Delivery<JointSample>, context: &mut Self::Context) {
        if self.sensor.at(Time::now(), context) != Some(sample.source) {
            context.reject();
            return;
        }
        if self.sample.is_none() {
            // From the first one on: before it there is nothing that could fall silent.
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
        // What is not central's, damaged, old, repeated or out of order does not come here.
        let Some(word) = self.word.as_ref().filter(|word| word.central == gait.source) else {
            context.reject();
            return;
        };
        let (t_ns, t_error_ns) = sent(&gait, gait.t_ns);
        let gait = GaitState { t_ns, t_error_ns, ..gait.payload };
        if word.guard.apply(|output| output.word = Some(gait)).is_err() {
            context.reject();
            return;
        }
        if !std::mem::replace(&mut self.central_heard, true) {
            context.watch_input::<GaitState>(None, SILENCE_MAX, |this, silence, _| {
                this.note_silence("gait state", silence);
            });
        }
    }
}

impl Handler<Delivery<TorqueSet>> for Drive {
    type Result = ();

    fn handle(&mut self, command: Delivery<TorqueSet>, context: &mut Self::Context) {
        let now = Time::now();
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
        let Some(word) = self.word.as_mut().filter(|word| word.central == arm.source) else {
            context.reject();
            return;
        };
        match word.arm(&arm, state) {
            Armed::Now => {}
            Armed::Before => return,
            Armed::Refused => {
                context.reject();
                return;
            }
        }
        self.note_event("armed", &arm.source.to_string(), String::new());
    }
}

impl Handler<Delivery<EmergencyStop>> for Drive {
    type Result = ();

    fn handle(&mut self, stop: Delivery<EmergencyStop>, _: &mut Self::Context) {
        // From anybody: to stop needs no right.
        tracing::warn!(joint = %self.parts.joint, by = %stop.source, "the e-stop was pressed");
        self.core.emergency_stop();
        self.note_event("e_stop", &stop.source.to_string(), String::new());
    }
}

impl Handler<Delivery<Reset>> for Drive {
    type Result = ();

    fn handle(&mut self, reset: Delivery<Reset>, context: &mut Self::Context) {
        let now = Time::now();
        if self.central.at(now, context).map(|central| central.node) != Some(reset.source.node) {
            context.reject();
            return;
        }
        match self.core.reset(now.as_nanos()) {
            Ok(()) => self.note_event("reset", &reset.source.to_string(), String::new()),
            Err(refusal) => {
                tracing::warn!(joint = %self.parts.joint, %refusal, "the e-stop stays");
                context.reject();
            }
        }
    }
}
