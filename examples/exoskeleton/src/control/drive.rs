//! The drive of one joint as one pure state machine: inputs and the time in, a torque out.
//!
//! ```text
//!          both inputs fresh        mode Walk
//!   Init ---------------------> Ready <-----> Walk
//!                                 ^             |
//!                  inputs fresh,  |             | input older than 10 ms, or mode Safe
//!                  mode not Safe  +--- Safe <---+        (the same tick)
//!   any state --- emergency_stop() ---> EStop --- reset() ---> Init
//! ```
//!
//! Invariants, each with a test: the torque is exactly 0.0 until `Walk` was reached once; it never exceeds the limit;
//! it never changes faster than the rate limit; what is stale or refused never reaches the torque law. One exception
//! to the first: a device that still holds a torque from an earlier life of its drive is ramped to zero, not stepped.

use super::admission::Admission;
use super::faults::{DriveCounters, FaultBits};
use super::ramp::{AssistRamp, RateLimiter};
use super::torque_law::{LawPhase, TorqueLaw};
use crate::joint::Joint;
use crate::message::{DriveState, DriveStatus, GaitMode, GaitState, JointSample};

/// Longest time for which the rate limiter moves in one tick, seconds; a late tick does not earn a step.
const TICK_LONGEST_S: f64 = 0.005;
/// A device torque below this at start counts as zero, Nm.
const HELD_TORQUE_MIN_NM: f32 = 0.5;

/// Numbers of one drive.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriveConfig {
    /// The assistance.
    pub law: TorqueLaw,
    /// Fastest change of torque, Nm/s. Default 2000.
    pub rate_limit_nm_s: f64,
    /// Damping in the safe state, Nms/rad. Default 1: more would brake the swing, none would let it fall.
    pub safe_damping_nms_rad: f64,
    /// Time in which assistance rises to full, seconds. Default 0.5.
    pub reentry_s: f64,
    /// Time from a command to its torque, seconds: bus and motor together. The moment is fed forward by as much.
    /// Default 6 ms: one message and the lag of the simulated device.
    pub device_lag_s: f64,
    /// Oldest input that is used, ns. Default 10 ms; above 20 ms a stuck torque becomes dangerous.
    pub input_age_max_ns: u64,
}

impl DriveConfig {
    /// The numbers of the domain notes.
    #[must_use]
    pub const fn standard(joint: Joint) -> Self {
        Self {
            law: TorqueLaw::standard(joint),
            rate_limit_nm_s: 2000.0,
            safe_damping_nms_rad: 1.0,
            reentry_s: 0.5,
            device_lag_s: 0.006,
            input_age_max_ns: 10_000_000,
        }
    }
}

/// What a tick of a drive gives.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriveOutput {
    /// Torque for the device, Nm; `None` while the drive has never heard its device and must stay silent.
    pub command_nm: Option<f64>,
    /// State after the tick.
    pub state: DriveState,
    /// Whether the torque law met the torque limit.
    pub saturated: bool,
    /// Gain of assistance, 0..1.
    pub assist_gain: f64,
    /// Age of the joint sample used, ns; `None` when there is none.
    pub sample_age_ns: Option<u64>,
    /// Age of the gait state used, ns; `None` when there is none.
    pub gait_age_ns: Option<u64>,
}

/// The drive of one joint.
#[derive(Debug, Clone)]
pub struct DriveCore {
    config: DriveConfig,
    state: DriveState,
    samples: Admission<JointSample>,
    gait: Admission<GaitState>,
    limiter: RateLimiter,
    ramp: AssistRamp,
    last_tick_ns: Option<u64>,
    device_heard: bool,
    counters: DriveCounters,
    faults: FaultBits,
    age_max_ns: u64,
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
            limiter: RateLimiter::new(config.rate_limit_nm_s),
            ramp: AssistRamp::new(config.reentry_s),
            last_tick_ns: None,
            device_heard: false,
            counters: DriveCounters {
                ticks: 0,
                misses: 0,
                saturated: 0,
                safe_entries: 0,
                samples_refused: *Admission::<JointSample>::new(0).refused(),
                gait_refused: *Admission::<GaitState>::new(0).refused(),
            },
            faults: FaultBits(0),
            age_max_ns: 0,
            status_seq: 0,
        }
    }

    /// One period of the drive. Give what has arrived since the last tick, or always the newest known: both work.
    pub fn tick(
        &mut self,
        now_ns: u64,
        sample: Option<&JointSample>,
        gait: Option<&GaitState>,
    ) -> DriveOutput {
        self.admit(now_ns, sample, gait);
        let elapsed_s = self.elapsed_s(now_ns);
        let dt_s = elapsed_s.min(TICK_LONGEST_S);
        let fresh_sample = self.samples.fresh(now_ns).copied();
        let fresh_gait = self.gait.fresh(now_ns).copied();
        self.judge_state(elapsed_s, fresh_sample.is_some(), fresh_gait.map(|g| g.mode));
        let (target_nm, saturated) = self.target((now_ns, dt_s), fresh_sample, fresh_gait);
        let limit_nm = self.config.law.limit_nm;
        let torque_nm = self.limiter.toward(target_nm.clamp(-limit_nm, limit_nm), dt_s);
        self.count(now_ns, saturated, fresh_sample.is_some() && fresh_gait.is_some());
        DriveOutput {
            command_nm: self.device_heard.then_some(torque_nm),
            state: self.state,
            saturated,
            assist_gain: self.ramp.gain(),
            sample_age_ns: self.samples.age_ns(now_ns),
            gait_age_ns: self.gait.age_ns(now_ns),
        }
    }

    /// Stops: from the next tick on the torque ramps to zero, and stays zero until [`DriveCore::reset`].
    /// A software e-stop; not a safety function.
    pub fn emergency_stop(&mut self) {
        self.state = DriveState::EStop;
        self.ramp.drop_to_zero();
        self.faults.insert(FaultBits::STOPPED);
    }

    /// Leaves `EStop` for `Init` and clears the fault bits. Nothing else leaves `EStop`.
    pub const fn reset(&mut self) {
        self.state = DriveState::Init;
        self.faults = FaultBits(0);
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
            state: self.state,
            faults: self.faults.0,
            torque_nm: self.limiter.torque_nm() as f32,
            age_max_us: u32::try_from(self.age_max_ns / 1000).unwrap_or(u32::MAX),
            misses: self.counters.misses,
        };
        self.status_seq = self.status_seq.wrapping_add(1);
        self.age_max_ns = 0;
        status
    }

    fn admit(&mut self, now_ns: u64, sample: Option<&JointSample>, gait: Option<&GaitState>) {
        if let Some(sample) = sample {
            let admitted = self.samples.offer(now_ns, sample);
            if admitted && !self.device_heard {
                self.device_heard = true;
                // A device that still holds a torque from an earlier life of this drive is ramped, not stepped.
                if sample.torque_nm.abs() >= HELD_TORQUE_MIN_NM {
                    self.limiter.start_from(f64::from(sample.torque_nm));
                }
            }
        }
        if let Some(gait) = gait {
            self.gait.offer(now_ns, gait);
        }
        self.counters.samples_refused = *self.samples.refused();
        self.counters.gait_refused = *self.gait.refused();
        if self.counters.samples_refused.total() > 0 {
            self.faults.insert(FaultBits::SAMPLE_REFUSED);
        }
        if self.counters.gait_refused.total() > 0 {
            self.faults.insert(FaultBits::GAIT_REFUSED);
        }
    }

    fn elapsed_s(&mut self, now_ns: u64) -> f64 {
        let before_ns = self.last_tick_ns.replace(now_ns).unwrap_or(now_ns);
        now_ns.saturating_sub(before_ns) as f64 * 1e-9
    }

    fn judge_state(&mut self, elapsed_s: f64, sample_fresh: bool, mode: Option<GaitMode>) {
        let next = next_state(self.state, sample_fresh, mode);
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

    /// The torque to go to, Nm, and whether the law met its limit.
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
                let torque = self.config.law.torque(&phase, angle_rad, velocity_rad_s);
                (self.ramp.rise(dt_s) * torque.torque_nm, torque.saturated)
            }
            (DriveState::Safe, Some(sample), _) => {
                (-self.config.safe_damping_nms_rad * f64::from(sample.velocity_rad_s), false)
            }
            // Without a velocity there is nothing to damp against; zero is the least harm.
            (DriveState::Safe, None, _)
            | (DriveState::Walk | DriveState::Init | DriveState::Ready | DriveState::EStop, _, _) => {
                (0.0, false)
            }
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
        self.age_max_ns = self.age_max_ns.max(age_ns.unwrap_or(0));
    }
}

/// Carries the phase from the stamp of the gait state to the stamp of the sample, and to when the torque will act.
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

/// The whole table of the state machine. `mode` is `None` when there is no fresh gait state.
fn next_state(state: DriveState, sample_fresh: bool, mode: Option<GaitMode>) -> DriveState {
    let mode = mode.filter(|_| sample_fresh);
    match (state, mode) {
        (DriveState::EStop, _) => DriveState::EStop,
        (DriveState::Init, None) => DriveState::Init,
        // A drive that never walked and loses an input waits again; it gives no torque either way.
        (DriveState::Ready, None) => DriveState::Init,
        (DriveState::Walk | DriveState::Safe, None) => DriveState::Safe,
        (DriveState::Init | DriveState::Ready, Some(GaitMode::Safe)) => DriveState::Ready,
        (DriveState::Walk | DriveState::Safe, Some(GaitMode::Safe)) => DriveState::Safe,
        // One tick of Ready before Walk: release is seen by a drive that has reported ready.
        (DriveState::Init, Some(GaitMode::Hold | GaitMode::Sync | GaitMode::Walk)) => DriveState::Ready,
        (DriveState::Ready | DriveState::Walk | DriveState::Safe, Some(GaitMode::Hold | GaitMode::Sync)) => {
            DriveState::Ready
        }
        (DriveState::Ready | DriveState::Walk | DriveState::Safe, Some(GaitMode::Walk)) => DriveState::Walk,
    }
}
