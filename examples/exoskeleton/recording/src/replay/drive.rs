//! The core of one drive, on recorded ticks.

use exoskeleton_model::control::drive::{DriveConfig, DriveCore};
use exoskeleton_model::joint::Joint;
use exoskeleton_model::message::{DriveState, DriveTick, GaitMode};

use super::inputs::DriveInputs;
use super::{Difference, JointResult, TickResult};

/// The replay of one joint's drive.
#[derive(Debug)]
pub(super) struct DriveReplay {
    config: DriveConfig,
    /// Factor for the recorded gains.
    gain_factor: f64,
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
    pub(super) fn new(joint: Joint, gain_factor: f64) -> Self {
        let (config, result) = (DriveConfig::standard(joint), JointResult::default());
        Self { config, gain_factor, core: None, last: None, began_ns: None, result, differs_ns: 0 }
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
        let Some(computed) = self.compute(tick, inputs) else { return };
        let recorded = TickResult::of(tick);
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

    /// Computes a tick again; `None`: the recording lacks its inputs, or the state before it.
    pub(super) fn compute(&mut self, tick: &DriveTick, inputs: Option<&DriveInputs>) -> Option<TickResult> {
        let last = self.last.replace(tick.seq);
        // A number that does not grow is that of another incarnation.
        let is_next = last.is_some_and(|last| tick.seq > last);
        if is_next && last.is_some_and(|last| tick.seq - last > 1) && self.core.is_some() {
            self.lose(tick, format!("the ticks before tick {} are not in the recording", tick.seq));
        }
        let begins = !is_next || self.core.is_none();
        if begins {
            self.begin(tick, inputs);
        }
        let core = self.core.as_mut()?;
        core.set_gains(tick.gains.unwrap_or(self.config.law.gains).times(self.gain_factor));
        let computed = match compute(core, tick, inputs) {
            Ok(computed) => computed,
            Err(missing) => {
                self.lose(tick, missing);
                return None;
            }
        };
        if begins && tick.seq != 1 && !computed.is(&TickResult::of(tick)) {
            // The drive was not in the state of a new one. The next tick at rest is tried.
            self.core = None;
            return None;
        }
        Some(computed)
    }

    /// Returns the first reason why ticks cannot be computed again.
    pub(super) const fn gap(&self) -> Option<&String> {
        self.result.gap.as_ref()
    }

    /// Begins with the first tick of a drive, or with a later one in which the drive is in the state of a new one.
    fn begin(&mut self, tick: &DriveTick, inputs: Option<&DriveInputs>) {
        self.core = (tick.seq == 1 || is_as_new(tick, inputs)).then(|| DriveCore::new(self.config));
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

/// Whether a new drive continues as this one. It is at rest and knows its device: before that, a pause decides which
/// samples count. Central does not let it walk: so assistance rises as after any interruption.
fn is_as_new(tick: &DriveTick, inputs: Option<&DriveInputs>) -> bool {
    let gait = tick.gait.and_then(|used| inputs?.gait(&used));
    is_at_rest(tick) && tick.torque_nm.is_some() && gait.is_some_and(|gait| gait.mode != GaitMode::Walk)
}

/// Whether the drive gives no torque, and has none to ramp to zero.
pub(super) fn is_at_rest(tick: &DriveTick) -> bool {
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

#[cfg(test)]
mod tests {
    use exoskeleton_model::message::{GaitState, JointSample, Stance};

    use super::*;

    const MS: u64 = 1_000_000;

    fn sample(seq: u32, t_ns: u64) -> JointSample {
        JointSample {
            seq,
            t_ns,
            t_error_ns: Some(0),
            angle_rad: 0.1,
            velocity_rad_s: 0.0,
            torque_nm: 0.0,
            temperature_c: 30,
            flags: 0,
        }
    }

    fn gait(mode: GaitMode, t_ns: u64) -> GaitState {
        GaitState {
            seq: u32::try_from(t_ns / MS).unwrap(),
            t_ns,
            t_error_ns: Some(0),
            phase: 0.0,
            phase_rate_hz: 0.0,
            stance: Stance::Stance,
            mode,
            confidence: 1.0,
            epoch: 1,
            degraded: 0,
        }
    }

    /// Runs the drive of a robot on these inputs, and replays its ticks without the first one.
    fn replayed_from_the_second(inputs: &[(u64, JointSample, GaitState)]) -> JointResult {
        let mut robot = DriveCore::new(DriveConfig::standard(Joint::Hip));
        let mut replay = DriveReplay::new(Joint::Hip, 1.0);
        let mut recorded = DriveInputs::default();
        for ((t_ns, sample, gait), seq) in inputs.iter().zip(1..) {
            recorded.samples.push_back(*sample);
            recorded.gaits.push_back(*gait);
            let before = robot.state();
            let output = robot.tick(*t_ns, Some(sample), Some(gait));
            let tick = DriveTick {
                joint: 0,
                seq,
                t_ns: *t_ns,
                late_us: 0,
                before,
                is_shut: false,
                sample: Some(sample.into()),
                gait: Some(gait.into()),
                gains: None,
                torque_nm: output.command_nm,
                assist_gain: output.assist_gain,
                state: output.state,
                damped_at_ns: None,
            };
            if seq > 1 {
                replay.run(&tick, Some(&recorded));
            }
        }
        replay.result(0)
    }

    #[test]
    fn recording_that_begins_with_a_pause_is_no_difference() {
        let hold = |t_ns| gait(GaitMode::Hold, t_ns);
        // The drive was not scheduled for 19 ms. The sample of that time does not show the torque of its device.
        let result = replayed_from_the_second(&[
            (MS, sample(1, MS / 2), hold(MS / 2)),
            (20 * MS, sample(2, 19 * MS), hold(19 * MS)),
            (21 * MS, sample(2, 19 * MS), hold(19 * MS)),
            (22 * MS, sample(3, 21 * MS + MS / 2), hold(21 * MS)),
            (23 * MS, sample(4, 22 * MS + MS / 2), hold(22 * MS)),
        ]);
        assert_eq!(result, JointResult { ticks: 4, compared: 2, identical: 2, ..JointResult::default() });
    }

    #[test]
    fn walk_without_its_begin_is_not_compared() {
        let walk = |t_ns| gait(GaitMode::Walk, t_ns);
        let result = replayed_from_the_second(&[
            (MS, sample(1, MS / 2), gait(GaitMode::Hold, MS / 2)),
            // It is ready, and the recording does not say whether assistance was interrupted before.
            (2 * MS, sample(2, MS + MS / 2), walk(MS + MS / 2)),
            (3 * MS, sample(3, 2 * MS + MS / 2), walk(2 * MS + MS / 2)),
        ]);
        assert_eq!((result.compared, result.first_difference), (0, None));
        assert!(result.gap.is_some(), "{result:?}");
    }
}
