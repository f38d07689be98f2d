//! The drive of one joint as one pure state machine: inputs and the time in, a torque out.
//!
//! ```text
//!          both inputs fresh        mode Walk
//!   Init ---------------------> Ready <-----> Walk
//!                                 ^             |
//!                  inputs fresh,  |             | input older than 10 ms, or mode Safe
//!                  mode not Safe  +--- Safe <---+        (the same tick)
//!   any state --- emergency_stop(), or mode Stop ---> EStop --- reset() ---> Init
//! ```
//!
//! Invariants, each with a test:
//!
//! - The torque is exactly 0.0 until `Walk` was reached once.
//! - It never exceeds the limit, and never changes faster than the rate limit.
//! - Stale or rejected inputs never reach the torque law.
//! - Only a reset leaves `EStop`.
//!
//! Exception to the first: a device that still holds a torque from an earlier incarnation of its drive is
//! ramped to zero, not stepped. The same holds after a pause of the drive itself, when its device may have
//! damped by itself: the drive continues from the torque that the device reports.

use thiserror::Error;

use super::admission::{Admission, Stamped};
use super::faults::{DriveCounters, FaultBits};
use super::ramp::{AssistRamp, RateLimiter};
use super::torque_law::{Gains, LawPhase, TorqueLaw};
use crate::joint::Joint;
use crate::message::{DriveState, DriveStatus, GaitMode, GaitState, JointSample, TorqueSet};

/// Maximum time for which the rate limiter moves in one tick, seconds; a late tick does not permit a step.
const TICK_LONGEST_S: f64 = 0.005;
/// A device torque below this at start counts as zero, Nm.
const HELD_TORQUE_MIN_NM: f64 = 0.5;

/// Parameters of one drive.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriveConfig {
    /// The assistance.
    pub law: TorqueLaw,
    /// Fastest change of torque, Nm/s. Default 2000.
    pub rate_limit_nm_s: f64,
    /// Damping in the safe state, Nms/rad. Default 1: more would brake the swing, none would let it fall.
    pub safe_damping_nms_rad: f64,
    /// Time in which assistance rises to full after it was interrupted for the whole leg, seconds. Default
    /// 0.5.
    pub reentry_s: f64,
    /// Time in which it rises to full when only this drive was away and the others walked on, seconds.
    /// Default 0.2: a joint without assistance is the greater harm.
    pub rejoin_s: f64,
    /// Time from a command to its torque, seconds: bus and motor together. The moment is fed forward by as much.
    /// Default 6 ms: one message and the lag of the simulated device.
    pub device_lag_s: f64,
    /// Oldest input that is used, ns. Default 10 ms; above 20 ms a stuck torque becomes dangerous.
    pub input_age_max_ns: u64,
    /// Maximum pause between two ticks over which the drive knows its device's torque, ns. Default 6 ms;
    /// shorter than the watchdog of any device.
    pub pause_max_ns: u64,
    /// Maximum distance of a torque set from outside from this drive's own feed-forward, Nm. Default 10.
    pub command_apart_max_nm: f64,
}

impl DriveConfig {
    /// The values of the domain notes.
    #[must_use]
    pub const fn standard(joint: Joint) -> Self {
        Self {
            law: TorqueLaw::standard(joint),
            rate_limit_nm_s: 2000.0,
            safe_damping_nms_rad: 1.0,
            reentry_s: 0.5,
            rejoin_s: 0.2,
            device_lag_s: 0.006,
            input_age_max_ns: 10_000_000,
            pause_max_ns: 6_000_000,
            command_apart_max_nm: 10.0,
        }
    }
}

/// The result of a tick.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriveOutput {
    /// Torque for the device, Nm; `None` while the drive has no reading of its device and must stay silent.
    pub command_nm: Option<f64>,
    /// State after the tick.
    pub state: DriveState,
    /// Whether the torque law reached the torque limit.
    pub saturated: bool,
    /// Gain of assistance, 0..1.
    pub assist_gain: f64,
    /// Age of the joint sample used, ns; `None` if there is none.
    pub sample_age_ns: Option<u64>,
    /// Age of the gait state used, ns; `None` if there is none.
    pub gait_age_ns: Option<u64>,
}

/// The reason why a drive stays stopped. The reset came too early; nothing has changed.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Error)]
pub enum ResetError {
    /// The torque is still being ramped to zero.
    #[error("the torque is not zero yet; wait 50 ms")]
    NotAtRest,
    /// Central is stopped itself.
    #[error("central still says stop; reset it first")]
    CentralStopped,
}

/// The drive of one joint.
#[derive(Debug, Clone)]
pub struct DriveCore {
    config: DriveConfig,
    state: DriveState,
    samples: Admission<JointSample>,
    gait: Admission<GaitState>,
    commands: Admission<TorqueSet>,
    limiter: RateLimiter,
    ramp: AssistRamp,
    last_tick_ns: Option<u64>,
    device_heard: bool,
    /// It was left to damp, and has sent no reading since.
    damps: bool,
    /// End of the last pause, or time at which the device was last left to damp, ns: older readings do not
    /// show its torque after that.
    paused_until_ns: Option<u64>,
    /// Whether central interrupted assistance since it was last full; else only this drive was away.
    interrupted: bool,
    counters: DriveCounters,
    faults: FaultBits,
    age_max_ns: Option<u64>,
    status_seq: u32,
}

impl DriveCore {
    /// A drive at rest.
    #[must_use]
    pub const fn new(config: DriveConfig) -> Self {
        Self {
            config,
            state: DriveState::Init,
            samples: Admission::new(config.input_age_max_ns),
            gait: Admission::new(config.input_age_max_ns),
            commands: Admission::new(config.input_age_max_ns),
            limiter: RateLimiter::new(config.rate_limit_nm_s),
            ramp: AssistRamp::new(config.reentry_s),
            last_tick_ns: None,
            device_heard: false,
            damps: false,
            paused_until_ns: None,
            interrupted: false,
            counters: DriveCounters {
                ticks: 0,
                misses: 0,
                saturated: 0,
                safe_entries: 0,
                samples_refused: *Admission::<JointSample>::new(0).refused(),
                gait_refused: *Admission::<GaitState>::new(0).refused(),
                commands_admitted: 0,
                commands_refused: *Admission::<TorqueSet>::new(0).refused(),
                pauses: 0,
            },
            faults: FaultBits(0),
            age_max_ns: None,
            status_seq: 0,
        }
    }

    /// Runs one period of the drive. Pass the inputs since the last tick, or always the newest known: both
    /// work.
    pub fn tick(
        &mut self,
        now_ns: u64,
        sample: Option<&JointSample>,
        gait: Option<&GaitState>,
    ) -> DriveOutput {
        let elapsed_s = self.elapsed_s(now_ns);
        self.doubt_after_pause(now_ns, elapsed_s);
        self.admit(now_ns, sample, gait);
        let dt_s = elapsed_s.min(TICK_LONGEST_S);
        let fresh_sample = self.samples.fresh(now_ns).copied();
        let fresh_gait = self.gait.fresh(now_ns).copied();
        self.judge_state(elapsed_s, fresh_sample.is_some(), fresh_gait.map(|g| g.mode));
        let (target_nm, saturated) = self.target((now_ns, dt_s), fresh_sample, fresh_gait);
        let limit_nm = self.config.law.limit_nm;
        // Without knowledge of the device's torque there is no starting point.
        let command_nm =
            self.device_heard.then(|| self.limiter.toward(target_nm.clamp(-limit_nm, limit_nm), dt_s));
        self.count(now_ns, saturated, fresh_sample.is_some() && fresh_gait.is_some());
        DriveOutput {
            command_nm,
            state: self.state,
            saturated,
            assist_gain: self.ramp.gain(),
            sample_age_ns: self.samples.age_ns(now_ns),
            gait_age_ns: self.gait.age_ns(now_ns),
        }
    }

    /// Sets the gains for the next ticks. The caller changes them gradually; the rate limit of the torque holds in any
    /// case.
    pub const fn set_gains(&mut self, gains: Gains) {
        self.config.law.gains = gains;
    }

    /// Stops: from the next tick on the torque ramps to zero, and stays zero until [`DriveCore::reset`].
    /// A software e-stop; not a safety function.
    pub fn emergency_stop(&mut self) {
        self.let_go();
        self.faults.insert(FaultBits::STOPPED);
    }

    /// The orderly end of a drive: like an e-stop, but no button was pressed.
    pub const fn let_go(&mut self) {
        self.state = DriveState::EStop;
        self.ramp.drop_to_zero();
    }

    /// Leaves `EStop` for `Init` and clears the fault bits. Nothing else leaves `EStop`.
    ///
    /// # Errors
    /// The drive is not at rest, or central still commands stop.
    pub fn reset(&mut self, now_ns: u64) -> Result<(), ResetError> {
        if self.state == DriveState::EStop {
            if self.limiter.torque_nm() != 0.0 {
                return Err(ResetError::NotAtRest);
            }
            if self.gait.fresh(now_ns).is_some_and(|gait| gait.mode == GaitMode::Stop) {
                return Err(ResetError::CentralStopped);
            }
            self.state = DriveState::Init;
        }
        self.faults = FaultBits(0);
        Ok(())
    }

    /// Central's commands do not count any more: the held one is not used either, from this tick on, until a
    /// new one arrives.
    pub const fn distrust_gait(&mut self) {
        self.gait.distrust();
    }

    /// The device damps by itself from `now_ns` on: its torque is read again, and until it is known nothing
    /// is commanded. If this is repeated before a reading arrives, the first time counts: a reading may take
    /// longer than a period.
    pub const fn let_device_damp(&mut self, now_ns: u64) {
        self.device_heard = false;
        if !self.damps {
            self.damps = true;
            self.paused_until_ns = Some(now_ns);
        }
    }

    /// Takes a moment to feed forward in place of its own for the next 10 ms; returns whether it is accepted.
    ///
    /// It has to be finite, within limits, newer than the last, young, and near to this drive's own value at
    /// this phase: a drive knows the right sign best. Rejected ones are counted and set a fault bit.
    pub fn command(&mut self, now_ns: u64, command: &TorqueSet) -> bool {
        let own_nm = self.own_feed_forward_nm(now_ns);
        let apart_nm = (f64::from(command.torque_nm) - own_nm).abs();
        let is_sane = Stamped::is_finite(command) && command.is_plausible();
        let admitted = if is_sane && apart_nm > self.config.command_apart_max_nm {
            self.commands.refuse_opposed();
            false
        } else {
            self.commands.offer(now_ns, command)
        };
        self.counters.commands_admitted += u32::from(admitted);
        if self.commands.refused().total() > self.counters.commands_refused.total() {
            self.faults.insert(FaultBits::COMMAND_REFUSED);
        }
        self.counters.commands_refused = *self.commands.refused();
        admitted
    }

    /// State of the drive.
    #[must_use]
    pub const fn state(&self) -> DriveState {
        self.state
    }

    /// Counters since the start.
    #[must_use]
    pub const fn counters(&self) -> &DriveCounters {
        &self.counters
    }

    /// Fault bits since the start or the last reset.
    #[must_use]
    pub const fn faults(&self) -> FaultBits {
        self.faults
    }

    /// The report of this drive; starts a new maximum of the age.
    pub fn status(&mut self, now_ns: u64) -> DriveStatus {
        let status = DriveStatus {
            seq: self.status_seq,
            t_ns: now_ns,
            t_error_ns: Some(0),
            state: self.state,
            faults: self.faults.0,
            torque_nm: self.limiter.torque_nm() as f32,
            age_max_us: self.age_max_ns.map(|age_ns| u32::try_from(age_ns / 1000).unwrap_or(u32::MAX)),
            misses: self.counters.misses,
            commands_taken: self.counters.commands_admitted,
            commands_refused: self.counters.commands_refused.total(),
        };
        self.status_seq = self.status_seq.wrapping_add(1);
        self.age_max_ns = None;
        status
    }

    /// After a pause the device may have damped by itself: its torque is read again, and until it is known
    /// nothing is commanded. This tick commands nothing either, as its reading lags behind.
    fn doubt_after_pause(&mut self, now_ns: u64, elapsed_s: f64) {
        if elapsed_s <= self.config.pause_max_ns as f64 * 1e-9 {
            return;
        }
        self.paused_until_ns = Some(now_ns);
        if std::mem::take(&mut self.device_heard) {
            self.counters.pauses = self.counters.pauses.saturating_add(1);
        }
    }

    /// This drive's own feed-forward now; 0 if no phase is known.
    fn own_feed_forward_nm(&self, now_ns: u64) -> f64 {
        let Some(gait) = self.gait.fresh(now_ns) else { return 0.0 };
        let ahead_s = now_ns.saturating_sub(gait.t_ns) as f64 * 1e-9 + self.config.device_lag_s;
        self.config.law.feed_forward_nm(f64::from(gait.phase) + f64::from(gait.phase_rate_hz) * ahead_s)
    }

    fn admit(&mut self, now_ns: u64, sample: Option<&JointSample>, gait: Option<&GaitState>) {
        if let Some(sample) = sample {
            let admitted = self.samples.offer(now_ns, sample);
            let of_now =
                self.paused_until_ns.is_none_or(|ns| now_ns > ns && sample.stamp().earliest_ns() > Some(ns));
            if admitted && of_now && !self.device_heard {
                (self.device_heard, self.damps) = (true, false);
                self.go_on_from(f64::from(sample.torque_nm));
            }
        }
        if let Some(gait) = gait {
            self.gait.offer(now_ns, gait);
        }
        if self.samples.refused().total() > self.counters.samples_refused.total() {
            self.faults.insert(FaultBits::SAMPLE_REFUSED);
        }
        if self.gait.refused().total() > self.counters.gait_refused.total() {
            self.faults.insert(FaultBits::GAIT_REFUSED);
        }
        self.counters.samples_refused = *self.samples.refused();
        self.counters.gait_refused = *self.gait.refused();
    }

    /// A device that holds a torque, from an earlier incarnation of this drive or by its own watchdog, is
    /// ramped, not stepped.
    fn go_on_from(&mut self, held_nm: f64) {
        let limit_nm = self.config.law.limit_nm;
        if held_nm.abs() >= HELD_TORQUE_MIN_NM {
            self.limiter.start_from(held_nm.clamp(-limit_nm, limit_nm));
        } else if self.limiter.torque_nm() != 0.0 {
            self.limiter.start_from(held_nm);
        }
    }

    fn elapsed_s(&mut self, now_ns: u64) -> f64 {
        let before_ns = self.last_tick_ns.replace(now_ns).unwrap_or(now_ns);
        now_ns.saturating_sub(before_ns) as f64 * 1e-9
    }

    fn judge_state(&mut self, elapsed_s: f64, sample_fresh: bool, mode: Option<GaitMode>) {
        let next = next_state(self.state, sample_fresh, mode);
        if mode == Some(GaitMode::Stop) {
            self.faults.insert(FaultBits::STOPPED);
        }
        self.interrupted |= mode.is_some_and(|mode| mode != GaitMode::Walk);
        if next == DriveState::Walk && self.state != DriveState::Walk {
            let config = &self.config;
            self.ramp.rise_in(if self.interrupted { config.reentry_s } else { config.rejoin_s });
        }
        if self.state == DriveState::Walk && next == DriveState::Safe {
            self.counters.safe_entries = self.counters.safe_entries.saturating_add(1);
            if mode != Some(GaitMode::Safe) {
                self.faults.insert(FaultBits::INPUT_LOST);
            }
        }
        match next {
            DriveState::Walk => {}
            DriveState::Safe => self.ramp.fall(elapsed_s),
            DriveState::Init | DriveState::Ready | DriveState::EStop => self.ramp.drop_to_zero(),
        }
        self.state = next;
    }

    /// The target torque, Nm, and whether the law reached its limit.
    fn target(
        &mut self,
        (now_ns, dt_s): (u64, f64),
        sample: Option<JointSample>,
        gait: Option<GaitState>,
    ) -> (f64, bool) {
        match (self.state, sample, gait) {
            (DriveState::Walk, Some(sample), Some(gait)) => {
                let phase = law_phase(&gait, &sample, now_ns, self.config.device_lag_s);
                let (angle_rad, velocity_rad_s) =
                    (f64::from(sample.angle_rad), f64::from(sample.velocity_rad_s));
                let feed_forward_nm = self.feed_forward_nm(now_ns, &phase);
                let law = &self.config.law;
                let torque = law.torque_around(feed_forward_nm, &phase, angle_rad, velocity_rad_s);
                let gain = self.ramp.rise(dt_s);
                // Full assistance: the interruption is over.
                self.interrupted &= gain < 1.0;
                (gain * torque.torque_nm, torque.saturated)
            }
            (DriveState::Safe, Some(sample), _) => {
                (-self.config.safe_damping_nms_rad * f64::from(sample.velocity_rad_s), false)
            }
            // Without a velocity there is no reference for damping; zero is the least harm.
            (DriveState::Safe, None, _)
            | (DriveState::Walk | DriveState::Init | DriveState::Ready | DriveState::EStop, _, _) => {
                (0.0, false)
            }
        }
    }

    /// The moment to feed forward, Nm: its own, or one from outside that is young and still near to it.
    fn feed_forward_nm(&self, now_ns: u64, phase: &LawPhase) -> f64 {
        let own_nm = self.config.law.feed_forward_nm(phase.at_effect);
        let apart_nm = self.config.command_apart_max_nm;
        match self.commands.fresh(now_ns) {
            Some(command) => f64::from(command.torque_nm).clamp(own_nm - apart_nm, own_nm + apart_nm),
            None => own_nm,
        }
    }

    fn count(&mut self, now_ns: u64, saturated: bool, complete: bool) {
        self.counters.ticks += 1;
        if saturated {
            self.counters.saturated = self.counters.saturated.saturating_add(1);
            self.faults.insert(FaultBits::SATURATED);
        }
        if !complete && self.state != DriveState::Init {
            self.counters.misses = self.counters.misses.saturating_add(1);
        }
        let age_ns = self.samples.age_ns(now_ns).max(self.gait.age_ns(now_ns));
        self.age_max_ns = self.age_max_ns.max(age_ns);
    }
}

/// Advances the phase from the stamp of the gait state to the stamp of the sample, and to the time of the
/// torque's effect.
fn law_phase(gait: &GaitState, sample: &JointSample, now_ns: u64, device_lag_s: f64) -> LawPhase {
    let (phase, rate_hz) = (f64::from(gait.phase), f64::from(gait.phase_rate_hz));
    let sample_after_s = (sample.t_ns as f64 - gait.t_ns as f64) * 1e-9;
    let effect_after_s = (now_ns as f64 - gait.t_ns as f64) * 1e-9 + device_lag_s;
    LawPhase {
        at_sample: phase + rate_hz * sample_after_s,
        at_effect: phase + rate_hz * effect_after_s,
        rate_hz,
    }
}

/// The whole table of the state machine. `mode` is `None` if there is no fresh gait state.
fn next_state(state: DriveState, sample_fresh: bool, mode: Option<GaitMode>) -> DriveState {
    if state == DriveState::EStop || mode == Some(GaitMode::Stop) {
        return DriveState::EStop;
    }
    let mode = mode.filter(|_| sample_fresh);
    match (state, mode) {
        (DriveState::EStop, _) | (_, Some(GaitMode::Stop)) => DriveState::EStop,
        (DriveState::Init, None) => DriveState::Init,
        // A drive that never walked and loses an input waits again; it commands no torque either way.
        (DriveState::Ready, None) => DriveState::Init,
        (DriveState::Walk | DriveState::Safe, None) => DriveState::Safe,
        (DriveState::Init | DriveState::Ready, Some(GaitMode::Safe)) => DriveState::Ready,
        (DriveState::Walk | DriveState::Safe, Some(GaitMode::Safe)) => DriveState::Safe,
        // One tick of Ready before Walk: the release reaches a drive that has reported ready.
        (DriveState::Init, Some(GaitMode::Hold | GaitMode::Sync | GaitMode::Walk)) => DriveState::Ready,
        (DriveState::Ready | DriveState::Walk | DriveState::Safe, Some(GaitMode::Hold | GaitMode::Sync)) => {
            DriveState::Ready
        }
        (DriveState::Ready | DriveState::Walk | DriveState::Safe, Some(GaitMode::Walk)) => DriveState::Walk,
    }
}
