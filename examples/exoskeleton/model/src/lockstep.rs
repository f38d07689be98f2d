//! The whole robot in virtual time: all cores in one thread; each message takes one millisecond.
//!
//! The loop is closed: central reads the simulated hip, not a recording. The same configuration gives the
//! same record bit by bit. This shows nothing about real-time performance.

mod world;

use thiserror::Error;

use crate::central::{CentralConfig, Resume};
use crate::intention::{Intention, IntentionError};
use crate::joint::{Joint, PerJoint};
use crate::part::Kill;
use crate::plant::PlantConfig;
use crate::record::Record;
use world::World;

/// Period of every core, ns.
pub const PERIOD_NS: u64 = 1_000_000;

/// The death of one drive alone: its sensor and its node keep running, and it is restarted.
#[derive(Debug, Clone, Copy, PartialEq)]
pub struct DriveDeath {
    /// The joint of the drive.
    pub joint: Joint,
    /// The true strides at which it dies, counted from 0: the whole part, and the phase within.
    pub at_strides: f64,
    /// Time until it runs again, ms.
    pub outage_ms: u64,
}

/// Configuration of a lock-step run.
#[derive(Debug, Clone)]
pub struct LockStepConfig {
    /// Strides to walk.
    pub strides: u32,
    /// Seed of sensor noise. The intention has its own.
    pub seed: u64,
    /// The motion that the person intends.
    pub intention: Intention,
    /// The plant.
    pub plant: PlantConfig,
    /// The central unit.
    pub central: CentralConfig,
    /// Start time of each joint's node, ms of the run; central starts at 0. The last one is the late node
    /// that the others wait for.
    pub start_ms: PerJoint<u64>,
    /// Time from readiness to release, ms.
    pub release_after_ms: u64,
    /// A node to kill.
    pub kill: Option<Kill>,
    /// Time until a killed node runs again, ms.
    pub outage_ms: u64,
    /// A drive to kill without its node.
    pub drive_death: Option<DriveDeath>,
}

impl LockStepConfig {
    /// The standard run: knee, then ankle, and the hip 2 s late; released half a second after all are ready.
    #[must_use]
    pub fn standard(strides: u32, seed: u64, intention: Intention) -> Self {
        Self {
            strides,
            seed,
            intention,
            plant: PlantConfig::default(),
            central: CentralConfig { resume: Resume::ByItself, ..CentralConfig::default() },
            start_ms: [2000, 150, 400],
            release_after_ms: 500,
            kill: None,
            outage_ms: 1000,
            drive_death: None,
        }
    }
}

/// The reason why a run failed.
#[derive(Debug, Clone, PartialEq, Eq, Error)]
pub enum LockStepError {
    /// The intention is too short.
    #[error(transparent)]
    Intention(#[from] IntentionError),
    /// The stride of the kill is beyond the run.
    #[error(
        "--kill {kill} lies beyond the {strides} strides of the run; use an earlier stride or more strides"
    )]
    KillBeyondRun {
        /// The requested kill.
        kill: Kill,
        /// Strides of the run.
        strides: u32,
    },
    /// The run did not reach its last stride within the maximum time.
    #[error(
        "the run did not finish within {limit_s} s of virtual time; the nodes never became ready together"
    )]
    NotFinished {
        /// Time limit, seconds.
        limit_s: u64,
    },
}

/// Runs the robot to its last stride.
///
/// # Errors
/// [`LockStepError`] if the intention is shorter than the run, the kill is beyond it, or it never finishes.
pub fn run(config: &LockStepConfig) -> Result<Record, LockStepError> {
    config.intention.check_strides(config.strides)?;
    if let Some(kill) = config.kill.filter(|kill| kill.stride > config.strides) {
        return Err(LockStepError::KillBeyondRun { kill, strides: config.strides });
    }
    // No stride is longer than four seconds, no start later than the last scripted one plus a margin.
    let latest_ms = config.start_ms.iter().max().copied().unwrap_or(0);
    let limit_s = 60 + latest_ms / 1000 + 4 * u64::from(config.strides);
    let mut world = World::new(config);
    for _ in 0..limit_s * 1000 {
        if world.strides_walked() >= f64::from(config.strides) {
            return Ok(world.into_record());
        }
        world.step();
    }
    Err(LockStepError::NotFinished { limit_s })
}
