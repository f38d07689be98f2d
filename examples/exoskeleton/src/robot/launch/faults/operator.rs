//! The operator: an application of central's node that presses buttons. A software e-stop; not a safety function.

use std::path::PathBuf;
use std::time::Duration;

use serde::{Deserialize, Serialize};
use sinew::{Class, Endpoint, NodeApi, Outcome, Payload, Registration, Tid, Time, client::ApiError};
use thiserror::Error;

use crate::joint::Joint;
use crate::message::{GaitMode, GaitState, Stance, TorqueSet};
use crate::robot::edges::{EmergencyStop, GAIT, Release, Reset, STOP, drive_name};

/// Time to reach central after it was started again.
const CONNECT_PATIENCE: Duration = Duration::from_secs(60);
const RETRY_PERIOD: Duration = Duration::from_millis(50);
/// Time for an answer.
const PATIENCE: Duration = Duration::from_secs(10);
/// A reset that comes too early is refused; then it is pressed again.
const RESETS_MAX: usize = 40;

/// Why a button did nothing. Nothing has changed.
#[derive(Debug, Clone, Error)]
pub enum OperatorError {
    /// Central's node is not there.
    #[error("the operator cannot reach central within {CONNECT_PATIENCE:?}: {0}")]
    Connect(String),
    /// It was there and is not any more, or does not answer.
    #[error("central does not hear the operator: {0}")]
    Lost(String),
    /// Nobody has the name that is to be told.
    #[error("nobody is called {0}")]
    Nobody(String),
}

/// The operator.
#[derive(Debug)]
pub(super) struct Operator {
    endpoint: Endpoint,
    seq: u32,
}

/// A gait state without the envelope that only central's own context can make.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct Unprotected(GaitState);

impl Payload for Unprotected {
    const NAME: &'static str = GaitState::NAME;
    const CLASS: Class = GaitState::CLASS;
}

/// Insane torques for a drive, and sane ones to compare with.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(super) enum Word {
    /// A torque as it may be asked for, Nm.
    Torque(f32),
    /// A torque under a sequence number of long ago, Nm.
    OldSequence(f32),
}

impl Operator {
    /// The operator's console, connected to central.
    pub(super) fn connect(socket: &PathBuf) -> Result<Self, OperatorError> {
        let deadline = Time::now() + CONNECT_PATIENCE;
        loop {
            let registration = Registration::new().name("operator").deadline(PATIENCE);
            let made = NodeApi::connect(socket).and_then(|api| api.register_transport_address(registration));
            match made {
                Ok(endpoint) => return Ok(Self { endpoint, seq: 1_000 }),
                Err(error) if Time::now() > deadline => {
                    return Err(OperatorError::Connect(error.to_string()));
                }
                // Central is starting, or has not yet noticed that the last console is gone.
                Err(_) => std::thread::sleep(RETRY_PERIOD),
            }
        }
    }

    /// Presses "walk"; what became of it.
    pub(super) fn release(&mut self) -> Result<Outcome, OperatorError> {
        self.press(GAIT, &Release {})
    }

    /// Presses the e-stop. Everybody hears it at once; there is no answer to wait for.
    pub(super) fn stop(&mut self) -> Result<(), OperatorError> {
        self.endpoint.send(Tid::group(STOP), &EmergencyStop {}).map_err(lost)
    }

    /// Takes the e-stop back: central first, then each drive; whether all have taken it.
    pub(super) fn reset(&mut self) -> Result<bool, OperatorError> {
        let mut all = self.press(GAIT, &Reset {})? == Outcome::Delivered;
        for joint in Joint::ALL {
            let mut taken = false;
            for _ in 0..RESETS_MAX {
                taken = self.press(&drive_name(joint), &Reset {})? == Outcome::Delivered;
                if taken {
                    break;
                }
                std::thread::sleep(RETRY_PERIOD);
            }
            all &= taken;
        }
        Ok(all)
    }

    /// Tells a drive which moment to feed forward.
    pub(super) fn set_torque(&mut self, joint: Joint, word: Word) -> Result<(), OperatorError> {
        self.seq += 1;
        let (seq, torque_nm) = match word {
            Word::Torque(torque_nm) => (self.seq, torque_nm),
            Word::OldSequence(torque_nm) => (self.seq - 500, torque_nm),
        };
        let drive = self.whoever_is(&drive_name(joint))?;
        // The drive takes the time of sending for its age.
        let set = TorqueSet { seq, t_ns: Time::now().as_nanos(), t_error_ns: Some(0), torque_nm, epoch: 1 };
        self.endpoint.send(drive, &set).map_err(lost)
    }

    /// Pretends to be central and says stop to all drives; they believe central's gait only.
    pub(super) fn pretend_to_be_central(&mut self) -> Result<(), OperatorError> {
        self.seq += 1;
        let state = GaitState {
            seq: self.seq,
            t_ns: Time::now().as_nanos(),
            t_error_ns: Some(0),
            phase: f32::NAN,
            phase_rate_hz: 0.0,
            stance: Stance::Swing,
            mode: GaitMode::Stop,
            confidence: 1.0,
            epoch: u32::MAX,
            degraded: 0,
        };
        for joint in Joint::ALL {
            let drive = self.whoever_is(&drive_name(joint))?;
            self.endpoint.send(drive, &Unprotected(state)).map_err(lost)?;
        }
        Ok(())
    }

    fn press<P: Payload>(&mut self, name: &str, word: &P) -> Result<Outcome, OperatorError> {
        let tid = self.whoever_is(name)?;
        self.endpoint.message(tid, word).confirmed(PATIENCE).map_err(lost)
    }

    fn whoever_is(&mut self, name: &str) -> Result<Tid, OperatorError> {
        let found = self.endpoint.resolve(name, PATIENCE).map_err(lost)?;
        found.ok_or_else(|| OperatorError::Nobody(name.to_owned()))
    }
}

#[expect(clippy::needless_pass_by_value, reason = "it is handed to `map_err`")]
fn lost(error: ApiError) -> OperatorError {
    OperatorError::Lost(error.to_string())
}
