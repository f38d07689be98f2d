//! The core of one drive, on recorded ticks.

use exoskeleton_model::control::drive::{DriveConfig, DriveCore};
use exoskeleton_model::message::{DriveState, DriveTick};

use super::inputs::DriveInputs;
use super::{Difference, JointResult, TickResult};

/// The replay of one joint's drive.
#[derive(Debug)]
pub(super) struct DriveReplay {
    config: DriveConfig,
    /// The core; `None`: its state is not known, as nothing or not everything of it is in the recording.
    core: Option<DriveCore>,
    /// The number of the last tick.
    last: Option<u32>,
    began_ns: Option<u64>,
    result: JointResult,
    /// The time of the first tick that differs.
    differs_ns: u64,
}

impl DriveReplay {
    pub(super) fn new(config: DriveConfig) -> Self {
        let result = JointResult::default();
        Self { config, core: None, last: None, began_ns: None, result, differs_ns: 0 }
    }

    /// Returns the time of the first tick, ns.
    pub(super) const fn began_ns(&self) -> Option<u64> {
        self.began_ns
    }

    /// Returns the result, with times since `began_ns`.
    pub(super) fn result(self, began_ns: u64) -> JointResult {
        let at_s = self.differs_ns.saturating_sub(began_ns) as f64 * 1e-9;
        let first_difference = self.result.first_difference.map(|found| Difference { at_s, ..found });
        JointResult { first_difference, ..self.result }
    }

    /// Computes a tick again, and compares it.
    pub(super) fn run(&mut self, tick: &DriveTick, inputs: Option<&DriveInputs>) {
        self.result.ticks += 1;
        self.began_ns.get_or_insert(tick.t_ns);
        let last = self.last.replace(tick.seq);
        // A number that does not grow is that of another incarnation.
        let is_next = last.is_some_and(|last| tick.seq > last);
        if is_next && last.is_some_and(|last| tick.seq - last > 1) && self.core.is_some() {
            self.lose(tick, format!("the ticks before tick {} are not in the recording", tick.seq));
        }
        if !is_next || self.core.is_none() {
            self.begin(tick);
        }
        let Some(core) = self.core.as_mut() else { return };
        let computed = match compute(core, tick, inputs) {
            Ok(computed) => computed,
            Err(missing) => {
                self.lose(tick, missing);
                return;
            }
        };
        let recorded =
            TickResult { torque_nm: tick.torque_nm, assist_gain: tick.assist_gain, state: tick.state };
        self.result.compared += 1;
        if computed.is(&recorded) {
            self.result.identical += 1;
        } else if self.result.first_difference.is_none() {
            self.differs_ns = tick.t_ns;
            // The beginning of the recording is known at its end.
            self.result.first_difference =
                Some(Difference { tick: tick.seq, at_s: 0.0, recorded, now: computed });
        }
    }

    /// Begins with the first tick of a drive, or with a later one in which the drive is at rest.
    fn begin(&mut self, tick: &DriveTick) {
        self.core = (tick.seq == 1 || is_at_rest(tick)).then(|| DriveCore::new(self.config));
        if self.core.is_none() {
            self.lose(
                tick,
                format!("before tick {} the recording has no tick of the drive at rest", tick.seq),
            );
        }
    }

    /// Gives up the drive until it is at rest. A drive at rest lost nothing. The first reason is kept.
    fn lose(&mut self, tick: &DriveTick, why: String) {
        self.core = None;
        if !is_at_rest(tick) {
            self.result.gap.get_or_insert(why);
        }
    }
}

/// Whether the state of the drive is that of a new one: it gives no torque, and has none to ramp to zero.
fn is_at_rest(tick: &DriveTick) -> bool {
    matches!(tick.before, DriveState::Init | DriveState::Ready)
        && tick.torque_nm.is_none_or(|torque_nm| torque_nm == 0.0)
}

/// Computes a tick; an error names the input that the recording lacks.
fn compute(
    core: &mut DriveCore,
    tick: &DriveTick,
    inputs: Option<&DriveInputs>,
) -> Result<TickResult, String> {
    let missing =
        |input: &str, seq: u32| format!("{input} {seq}, used by tick {}, is not in the recording", tick.seq);
    let sample = tick.sample.map(|used| {
        inputs.and_then(|inputs| inputs.sample(&used)).ok_or_else(|| missing("sample", used.seq))
    });
    let gait = tick.gait.map(|used| {
        inputs.and_then(|inputs| inputs.gait(&used)).ok_or_else(|| missing("gait state", used.seq))
    });
    let (sample, gait) = (sample.transpose()?, gait.transpose()?);
    if core.state() != tick.before {
        // Orders that are no input of a tick: the e-stop or the end of the drive, and the reset.
        match tick.before {
            DriveState::EStop => core.let_go(),
            DriveState::Init => {
                // A refusal shows as another state.
                let _ = core.reset(tick.t_ns);
            }
            DriveState::Ready | DriveState::Walk | DriveState::Safe => {}
        }
    }
    if tick.is_shut {
        core.distrust_gait();
    }
    let output = core.tick(tick.t_ns, sample.as_ref(), gait.as_ref());
    if let Some(at_ns) = tick.damped_at_ns {
        core.let_device_damp(at_ns);
    }
    let (torque_nm, assist_gain, state) = (output.command_nm, output.assist_gain, output.state);
    Ok(TickResult { torque_nm, assist_gain, state })
}
