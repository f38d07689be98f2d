//! The operator: an application of central's node that presses buttons. A software e-stop; not a safety function.

use std::path::PathBuf;
use std::time::Duration;

use exoskeleton::robot::edges::{EmergencyStop, GAIT, Release, Reset, STOP, drive_name};
use exoskeleton_model::joint::Joint;
use exoskeleton_model::message::{GaitMode, GaitState, Stance, TorqueSet};
use serde::{Deserialize, Serialize};
use sinew::{Class, Endpoint, NodeApi, Outcome, Payload, Registration, Tid, Time, client::ApiError};
use thiserror::Error;

/// Time to reach central after its restart.
const CONNECT_PATIENCE: Duration = Duration::from_secs(60);
const RETRY_PERIOD: Duration = Duration::from_millis(50);
/// Time for an answer.
const PATIENCE: Duration = Duration::from_secs(10);
/// A reset that comes too early is rejected; then it is sent again.
const RESETS_MAX: usize = 40;

/// The reason why a button did nothing. Nothing has changed.
#[derive(Debug, Clone, Error)]
pub(crate) enum OperatorError {
    /// Central's node is not running.
    #[error("the operator cannot reach central within {CONNECT_PATIENCE:?}: {0}")]
    Connect(String),
    /// The connection was lost, or central does not answer.
    #[error("central does not receive from the operator: {0}")]
    Lost(String),
    /// No application has the receiver's name.
    #[error("nobody is called {0}")]
    Nobody(String),
}

/// The operator.
#[derive(Debug)]
pub(crate) struct Operator {
    endpoint: Endpoint,
    seq: u32,
}

/// A gait state without the envelope, which only central's own context can create.
#[derive(Debug, Clone, Copy, Serialize, Deserialize)]
struct Unprotected(GaitState);

impl Payload for Unprotected {
    const NAME: &'static str = GaitState::NAME;
    const CLASS: Class = GaitState::CLASS;
}

/// Insane torques for a drive, and sane ones to compare with.
#[derive(Debug, Clone, Copy, PartialEq)]
pub(crate) enum OperatorCommand {
    /// A torque within the limits, Nm.
    Torque(f32),
    /// A torque under a very old sequence number, Nm.
    OldSequence(f32),
}

impl Operator {
    /// Connects the operator's console to central.
    pub(crate) fn connect(socket: &PathBuf) -> Result<Self, OperatorError> {
        let deadline = Time::now() + CONNECT_PATIENCE;
        loop {
            let registration = Registration::new().name("operator").deadline(PATIENCE);
            let made = NodeApi::connect(socket).and_then(|api| api.register_transport_address(registration));
            match made {
                Ok(endpoint) => return Ok(Self { endpoint, seq: 1_000 }),
                Err(error) if Time::now() > deadline => {
                    return Err(OperatorError::Connect(error.to_string()));
                }
                // Central is starting, or has not yet detected that the last console is gone.
                Err(_) => std::thread::sleep(RETRY_PERIOD),
            }
        }
    }

    /// Presses "walk"; returns the outcome.
    pub(crate) fn release(&mut self) -> Result<Outcome, OperatorError> {
        self.press(GAIT, &Release {})
    }

    /// Presses the e-stop. All applications of the group receive it at once; there is no answer to wait for.
    pub(crate) fn stop(&mut self) -> Result<(), OperatorError> {
        self.endpoint.send(Tid::group(STOP), &EmergencyStop {}).map_err(lost)
    }

    /// Resets the e-stop: central first, then each drive; returns whether all have accepted it.
    pub(crate) fn reset(&mut self) -> Result<bool, OperatorError> {
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

    /// Sends a drive the moment to feed forward.
    pub(crate) fn set_torque(&mut self, joint: Joint, command: OperatorCommand) -> Result<(), OperatorError> {
        self.seq += 1;
        let (seq, torque_nm) = match command {
            OperatorCommand::Torque(torque_nm) => (self.seq, torque_nm),
            OperatorCommand::OldSequence(torque_nm) => (self.seq - 500, torque_nm),
        };
        let drive = self.resolve(&drive_name(joint))?;
        // The drive computes its age from the time of sending.
        let set = TorqueSet { seq, t_ns: Time::now().as_nanos(), t_error_ns: Some(0), torque_nm, epoch: 1 };
        self.endpoint.send(drive, &set).map_err(lost)
    }

    /// Impersonates central and commands stop to all drives; they accept central's gait only.
    pub(crate) fn impersonate_central(&mut self) -> Result<(), OperatorError> {
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
            let drive = self.resolve(&drive_name(joint))?;
            self.endpoint.send(drive, &Unprotected(state)).map_err(lost)?;
        }
        Ok(())
    }

    fn press<P: Payload>(&mut self, name: &str, command: &P) -> Result<Outcome, OperatorError> {
        let tid = self.resolve(name)?;
        self.endpoint.message(tid, command).confirmed(PATIENCE).map_err(lost)
    }

    fn resolve(&mut self, name: &str) -> Result<Tid, OperatorError> {
        let found = self.endpoint.resolve(name, PATIENCE).map_err(lost)?;
        found.ok_or_else(|| OperatorError::Nobody(name.to_owned()))
    }
}

#[expect(clippy::needless_pass_by_value, reason = "it is handed to `map_err`")]
fn lost(error: ApiError) -> OperatorError {
    OperatorError::Lost(error.to_string())
}
