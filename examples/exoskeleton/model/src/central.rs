//! The central unit: estimates the gait phase from hip sample and foot load, and commands the drives.
//!
//! ```text
//!   assembling --- all inputs fresh ---> Hold --- release() ---> Sync --- phase trusted ---> Walk
//!                                                                 ^                           |
//!                                 all back and fresh              |   an input or a node lost |
//!                                 Safe ---------------------------+<--------- Safe <----------+
//! ```
//!
//! `stop()` leads to `Stop` from anywhere, and so does a drive that reports that it was stopped. It is
//! latched: only `reset()` leaves it, for `assembling`, and walking has to be released again; a release
//! pressed meanwhile is rejected.
//!
//! [`CentralConfig::resume`] decides whether a longer loss ends in `Sync` by itself, or waits in `Hold` for
//! the operator's release. A drive that does not assist although it should does not stop the others: its
//! joint is flagged as degraded.
//!
//! A silence of at most a quarter of a second, a hiccup of a host, does not make the phase unknown: from
//! `Safe` it returns at once to its previous mode, and the drives' ramps restore assistance.
//!
//! While assembling it sends nothing, so that no drive becomes ready before all parts are running.

mod drives;

use crate::control::admission::{Admission, Stamp, Stamped};
use crate::joint::{Joint, PerJoint};
use crate::leg::{BODY_MASS_KG, GRAVITY_M_S2};
use crate::message::{DriveStatus, FootLoad, GaitMode, GaitState, JointSample, Stance};
use crate::phase::PhaseEstimate;
use crate::phase::hand_over::{HandOver, HandOverConfig};
use crate::phase::heel_strike::CONTACT_BW;
use crate::phase::oscillator::{Oscillator, OscillatorGains};
use crate::phase::stride_clock::StrideClock;
use drives::Drives;

pub use drives::bit;

/// Maximum time for which the estimator is advanced with the inputs at its end, seconds.
const TICK_LONGEST_S: f64 = 0.005;

/// The estimator of the phase.
#[derive(Debug, Clone, Copy, PartialEq)]
pub enum Estimator {
    /// Adaptive oscillator on the hip angle, zeroed by heel strikes.
    Oscillator(OscillatorGains),
    /// Stride clock first, oscillator once it has been accurate. The default.
    HandOver(HandOverConfig),
    /// Time since heel strike over the mean of the last three strides; assumes strides of this many seconds
    /// until it has measured some.
    StrideClock {
        /// First assumption, seconds.
        stride_s: f64,
    },
}

/// The reaction when all parts are back after one was lost.
#[derive(Debug, Clone, Copy, PartialEq, Eq)]
pub enum Resume {
    /// Walking continues by itself.
    ByItself,
    /// Nothing moves until the operator releases again. The default.
    ByOperator,
}

/// A release that was rejected; nothing has changed. The e-stop was pressed and not yet reset.
#[derive(Debug, Clone, Copy, PartialEq, Eq, thiserror::Error)]
#[error("the e-stop is latched: reset it first, central and then the drives")]
pub struct EStopLatchedError;

/// Parameters of the central unit.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct CentralConfig {
    /// The estimator of the phase.
    pub estimator: Estimator,
    /// Oldest input that is used, ns. Default 10 ms.
    pub input_age_max_ns: u64,
    /// Heel strikes in a row with a trusted phase before assistance starts or comes back. Default 3.
    pub strikes_trusted: u32,
    /// Largest error of the phase at a heel strike that counts as trusted, cycles. Default 0.10.
    pub strike_error_max: f64,
    /// Time without a heel strike after which the phase is not trusted any more, seconds. Default 2.5.
    pub strike_gap_max_s: f64,
    /// Maximum silence of an input over which the phase is still valid, seconds; after a longer one the
    /// estimator starts cold. Default 0.25, a fifth of a stride. The drives damp from the first stale tick on
    /// in any case.
    pub gap_coast_max_s: f64,
    /// The reaction to a return after a loss.
    pub resume: Resume,
    /// Maximum time without a report of a drive that it assists, while it should, before its joint counts as
    /// degraded, seconds. Default 0.025: five statuses.
    pub drive_silence_max_s: f64,
    /// Number of this incarnation of central; larger than that of any earlier one.
    pub epoch: u32,
}

impl Default for CentralConfig {
    fn default() -> Self {
        Self {
            estimator: Estimator::HandOver(HandOverConfig::default()),
            input_age_max_ns: 10_000_000,
            strikes_trusted: 3,
            strike_error_max: 0.10,
            strike_gap_max_s: 2.5,
            gap_coast_max_s: 0.25,
            resume: Resume::ByOperator,
            drive_silence_max_s: 0.025,
            epoch: 1,
        }
    }
}

/// The inputs that have arrived at central since the last tick, or the newest known of each.
#[derive(Debug, Clone, Copy, Default)]
pub struct CentralInput<'a> {
    /// Samples of the three joints.
    pub samples: PerJoint<Option<&'a JointSample>>,
    /// Load under the foot.
    pub load: Option<&'a FootLoad>,
}

/// Counters of central since its start.
#[derive(Debug, Clone, Copy, PartialEq, Eq, Default)]
pub struct CentralCounters {
    /// Ticks done.
    pub ticks: u64,
    /// Number of times that an input or a node was lost while released.
    pub losses: u32,
    /// Number of times that assistance was allowed.
    pub walks: u32,
    /// Heel strikes seen by this incarnation.
    pub heel_strikes: u32,
    /// Inputs rejected.
    pub refused: u32,
}

#[derive(Debug, Clone, Copy, PartialEq, Eq)]
enum Stage {
    Assembling,
    Held,
    Syncing,
    Walking,
    Lost,
    Stopped,
}

#[derive(Debug, Clone)]
enum RunningEstimator {
    Oscillator(Box<Oscillator>),
    HandOver(Box<HandOver>),
    StrideClock(StrideClock),
}

/// The central unit.
#[derive(Debug, Clone)]
pub struct CentralCore {
    config: CentralConfig,
    stage: Stage,
    released: bool,
    nodes_lost: PerJoint<bool>,
    drives: Drives,
    samples: PerJoint<Admission<JointSample>>,
    load: Admission<FootLoad>,
    estimator: RunningEstimator,
    estimate: PhaseEstimate,
    confidence: f64,
    strikes_good: u32,
    since_strike_s: f64,
    last_tick_ns: Option<u64>,
    /// Time for which the estimator has received nothing, seconds.
    unheard_s: f64,
    /// The stage before an input was lost.
    lost_from: Stage,
    seq: u32,
    counters: CentralCounters,
}

impl CentralCore {
    /// Creates a central unit without any input yet.
    #[must_use]
    pub fn new(config: CentralConfig) -> Self {
        Self {
            config,
            stage: Stage::Assembling,
            released: false,
            nodes_lost: [false; 3],
            drives: Drives::new(config.drive_silence_max_s),
            samples: std::array::from_fn(|_| Admission::new(config.input_age_max_ns)),
            load: Admission::new(config.input_age_max_ns),
            estimator: RunningEstimator::cold(config.estimator),
            estimate: PhaseEstimate { phase: 0.0, rate_hz: 0.0, strike_error: None },
            confidence: 0.0,
            strikes_good: 0,
            since_strike_s: 0.0,
            last_tick_ns: None,
            unheard_s: 0.0,
            lost_from: Stage::Assembling,
            seq: 0,
            counters: CentralCounters::default(),
        }
    }

    /// Runs one period of central. `None` while it still waits for the first message of a part.
    pub fn tick(&mut self, now_ns: u64, input: &CentralInput<'_>) -> Option<GaitState> {
        let before_ns = self.last_tick_ns.replace(now_ns).unwrap_or(now_ns);
        let dt_s = now_ns.saturating_sub(before_ns) as f64 * 1e-9;
        self.counters.ticks += 1;
        self.admit(now_ns, input);
        let complete = self.complete(now_ns);
        self.unheard_s += dt_s;
        self.judge_stage(complete);
        if complete && matches!(self.stage, Stage::Syncing | Stage::Walking) {
            let dt_s = self.coast();
            self.estimate_phase(dt_s);
        }
        self.judge_trust();
        self.drives.tick(dt_s, self.stage == Stage::Walking);
        self.mode().map(|mode| self.gait_state(now_ns, mode))
    }

    /// Releases walking on the operator's behalf; takes effect once all parts are running.
    ///
    /// # Errors
    /// The e-stop was pressed and not reset, here or at a drive.
    pub fn release(&mut self) -> Result<(), EStopLatchedError> {
        if self.stage == Stage::Stopped || self.drives.any_stopped() {
            return Err(EStopLatchedError);
        }
        self.released = true;
        Ok(())
    }

    /// The e-stop was pressed: the drives are commanded to stop from the next tick on, until
    /// [`CentralCore::reset`]. A software e-stop; not a safety function.
    pub const fn stop(&mut self) {
        self.stage = Stage::Stopped;
        self.released = false;
    }

    /// The operator resets the e-stop. All parts have to be running and walking has to be released again.
    pub fn reset(&mut self) {
        if self.stage == Stage::Stopped {
            self.stage = Stage::Assembling;
        }
    }

    /// The incarnation of a drive has ended, as a lower layer reports at once; central need not wait for its
    /// silence.
    pub const fn drive_ended(&mut self, joint: Joint, now_ns: u64) {
        self.drives.ended(joint, now_ns);
    }

    /// Processes the status of a drive; its stamp is in the clock of the ticks.
    pub fn on_drive_status(&mut self, now_ns: u64, joint: Joint, status: &DriveStatus) {
        self.drives.on_status(now_ns, joint, status);
    }

    /// Joints that walk without their drive's help: bit 0 hip, bit 1 knee, bit 2 ankle.
    #[must_use]
    pub fn degraded(&self) -> u8 {
        self.drives.degraded()
    }

    /// The operator withdraws the release: torque zero from the next tick on.
    pub const fn hold(&mut self) {
        self.released = false;
    }

    /// A lower layer has lost a joint's node; central need not wait for its samples to age.
    pub const fn node_lost(&mut self, joint: Joint) {
        self.nodes_lost[joint.index()] = true;
    }

    /// The joint's node is found again.
    pub const fn node_found(&mut self, joint: Joint) {
        self.nodes_lost[joint.index()] = false;
    }

    /// Counters since the start.
    #[must_use]
    pub const fn counters(&self) -> &CentralCounters {
        &self.counters
    }

    /// The command for the drives; `None` while a part was never received.
    #[must_use]
    pub const fn mode(&self) -> Option<GaitMode> {
        match self.stage {
            Stage::Assembling => None,
            Stage::Held => Some(GaitMode::Hold),
            Stage::Syncing => Some(GaitMode::Sync),
            Stage::Walking => Some(GaitMode::Walk),
            Stage::Lost => Some(GaitMode::Safe),
            Stage::Stopped => Some(GaitMode::Stop),
        }
    }

    fn admit(&mut self, now_ns: u64, input: &CentralInput<'_>) {
        for (admission, sample) in self.samples.iter_mut().zip(input.samples) {
            if let Some(sample) = sample {
                admission.offer(now_ns, sample);
            }
        }
        if let Some(load) = input.load {
            self.load.offer(now_ns, load);
        }
        self.counters.refused =
            self.samples.iter().map(|a| a.refused().total()).sum::<u32>() + self.load.refused().total();
    }

    fn complete(&self, now_ns: u64) -> bool {
        self.load.fresh(now_ns).is_some()
            && self.samples.iter().all(|a| a.fresh(now_ns).is_some())
            && !self.nodes_lost.contains(&true)
    }

    fn judge_stage(&mut self, complete: bool) {
        let is_hiccup = self.stage == Stage::Lost && self.unheard_s <= self.config.gap_coast_max_s;
        if self.drives.any_stopped() {
            self.heed_stopped_drive();
        }
        if self.stage == Stage::Lost && !is_hiccup && self.config.resume == Resume::ByOperator {
            self.released = false;
        }
        let next = match (self.stage, complete, self.released) {
            (Stage::Stopped, _, _) => Stage::Stopped,
            (Stage::Assembling, false, _) => Stage::Assembling,
            // Not yet released, so there was no torque that would have to be damped: wait for the parts
            // again.
            (Stage::Held, false, _) => Stage::Assembling,
            (Stage::Syncing | Stage::Walking | Stage::Lost, false, _) => Stage::Lost,
            (_, true, false) => Stage::Held,
            (Stage::Lost, true, true) if is_hiccup => self.lost_from,
            (Stage::Assembling | Stage::Held | Stage::Lost, true, true) => Stage::Syncing,
            (Stage::Syncing, true, true) => Stage::Syncing,
            (Stage::Walking, true, true) => Stage::Walking,
        };
        if next == Stage::Lost && self.stage != Stage::Lost {
            self.lost_from = self.stage;
            self.counters.losses = self.counters.losses.saturating_add(1);
        }
        if next == Stage::Syncing && self.stage != Stage::Syncing && !is_hiccup {
            self.start_cold();
        }
        self.stage = next;
    }

    /// Handles a drive that was stopped while this did not receive it, or that has started since: all are
    /// stopped. If nothing was released yet, preventing the release is enough.
    const fn heed_stopped_drive(&mut self) {
        match self.stage {
            Stage::Syncing | Stage::Walking | Stage::Lost => self.stop(),
            Stage::Assembling | Stage::Held | Stage::Stopped => self.released = false,
        }
    }

    /// Creates a new estimator: earlier data, from before standing or a gap, does not predict the phase now.
    fn start_cold(&mut self) {
        self.estimator = RunningEstimator::cold(self.config.estimator);
        self.confidence = 0.0;
        self.strikes_good = 0;
        self.since_strike_s = 0.0;
        self.unheard_s = 0.0;
    }

    /// Advances the estimator over the time without inputs, except the last tick's; returns that.
    fn coast(&mut self) -> f64 {
        let unheard_s = std::mem::take(&mut self.unheard_s);
        let coasted_s = (unheard_s - TICK_LONGEST_S).max(0.0);
        if coasted_s > 0.0 {
            match &mut self.estimator {
                RunningEstimator::Oscillator(oscillator) => oscillator.coast(coasted_s),
                RunningEstimator::HandOver(both) => both.coast(coasted_s),
                RunningEstimator::StrideClock(clock) => clock.coast(coasted_s),
            }
            self.since_strike_s += coasted_s;
        }
        unheard_s - coasted_s
    }

    fn estimate_phase(&mut self, dt_s: f64) {
        let (Some(hip), Some(load)) = (self.samples[Joint::Hip.index()].newest(), self.load.newest()) else {
            return;
        };
        let hip_deg = f64::from(hip.angle_rad).to_degrees();
        let load_bw = load_bw(load);
        self.estimate = match &mut self.estimator {
            RunningEstimator::Oscillator(oscillator) => oscillator.tick(hip_deg, load_bw, dt_s),
            RunningEstimator::HandOver(both) => both.tick(hip_deg, load_bw, dt_s),
            RunningEstimator::StrideClock(clock) => clock.tick(load_bw, dt_s),
        };
        self.since_strike_s += dt_s;
        if let Some(error) = self.estimate.strike_error {
            self.counters.heel_strikes = self.counters.heel_strikes.saturating_add(1);
            self.since_strike_s = 0.0;
            self.confidence = (1.0 - 0.5 * error.abs() / self.config.strike_error_max).clamp(0.0, 1.0);
            let good = error.abs() <= self.config.strike_error_max;
            self.strikes_good = if good { self.strikes_good.saturating_add(1) } else { 0 };
        }
    }

    fn judge_trust(&mut self) {
        let overdue = self.since_strike_s > self.config.strike_gap_max_s;
        if self.stage == Stage::Syncing && self.strikes_good >= self.config.strikes_trusted {
            self.stage = Stage::Walking;
            self.counters.walks = self.counters.walks.saturating_add(1);
        } else if self.stage == Stage::Walking && (overdue || self.confidence <= 0.0) {
            // The person has stopped or changed step: stop assisting, estimate again.
            self.stage = Stage::Syncing;
            self.start_cold();
        }
    }

    fn gait_state(&mut self, now_ns: u64, mode: GaitMode) -> GaitState {
        let seq = self.seq;
        self.seq = seq.wrapping_add(1);
        let loaded = self.load.newest().is_some_and(|load| load_bw(load) >= CONTACT_BW);
        GaitState {
            seq,
            t_ns: now_ns,
            t_error_ns: Some(0),
            phase: self.estimate.phase as f32,
            phase_rate_hz: self.estimate.rate_hz as f32,
            stance: if loaded { Stance::Stance } else { Stance::Swing },
            mode,
            confidence: self.confidence as f32,
            epoch: self.config.epoch,
            degraded: self.drives.degraded(),
        }
    }
}

impl RunningEstimator {
    fn cold(estimator: Estimator) -> Self {
        match estimator {
            Estimator::Oscillator(gains) => Self::Oscillator(Box::new(Oscillator::new(gains))),
            Estimator::HandOver(config) => Self::HandOver(Box::new(HandOver::new(config))),
            Estimator::StrideClock { stride_s } => Self::StrideClock(StrideClock::new(stride_s)),
        }
    }
}

fn load_bw(load: &FootLoad) -> f64 {
    f64::from(load.heel_n + load.toe_n) / (BODY_MASS_KG * GRAVITY_M_S2)
}

impl Stamped for FootLoad {
    fn stamp(&self) -> Stamp {
        Stamp { t_ns: self.t_ns, t_error_ns: self.t_error_ns, seq: self.seq, epoch: 0 }
    }
    fn is_finite(&self) -> bool {
        self.heel_n.is_finite() && self.toe_n.is_finite()
    }
    fn is_plausible(&self) -> bool {
        (-500.0..=8000.0).contains(&self.heel_n) && (-500.0..=8000.0).contains(&self.toe_n)
    }
}
