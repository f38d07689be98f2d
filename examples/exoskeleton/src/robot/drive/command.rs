//! Central's commands, the guard that accepts only them, and the conditions for opening it.

use std::io;

use exoskeleton_model::message::{DriveState, GaitState};
use sinew::contracts::Contract;
use sinew::prelude::{AppContext, Delivery, Duration, Tid};
use sinew::protection::{ArmError, Guard, State};
use sinew::time::Clock;

use super::anomaly::Anomaly;
use super::damping_repeater::RepeaterHandle;
use super::{Drive, SILENCE_MAX};
use crate::robot::device::Damper;
use crate::robot::edges::{Arm, GAIT};

/// Time from central's last command until the device is ordered to damp: up to 60 ms of age and 10 ms of silence, and
/// the node's slack. Only a network that delays commands by as much as they may be old makes it that long.
const DAMPED_WITHIN: Duration = Duration::from_millis(100);

/// Age of central's newest command from which the guard accepts none: `age_max` of [`GaitState`]. A younger one may be
/// too old for a new torque, but the guard stays open.
const TOO_OLD: Duration = Duration::from_millis(60);

/// Returns the drive's contract with central.
pub(super) fn contract() -> Contract {
    Contract::when_lost(GAIT).or_late(TOO_OLD).or_stopped().goes_to("damped", DAMPED_WITHIN)
}

/// The commands of central.
pub(super) struct CentralCommands {
    /// The central application that sends them.
    pub(super) central: Tid,
    pub(super) guard: Guard<Output>,
    /// Accepts requests to open the other guard. It exists only while that is shut, so that no request of
    /// another time counts.
    arms: Option<Guard<()>>,
    anomaly: Anomaly,
}

/// The state that is removed as soon as central's commands do not count, by the thread that detects it first.
pub(super) struct Output {
    pub(super) command: Option<GaitState>,
    device: Box<dyn Damper>,
    /// Whether the device was ordered to apply a torque: a device without torque is left unchanged.
    pub(super) gives: bool,
    pub(super) again: RepeaterHandle,
    clock: Clock,
}

/// The result of an [`Arm`].
pub(super) enum Armed {
    /// Central's commands count from now on.
    Now,
    /// They counted before.
    Before,
    /// They do not count.
    Refused,
}

impl Output {
    pub(super) fn new(device: Box<dyn Damper>, again: RepeaterHandle, clock: Clock) -> Self {
        Self { command: None, device, gives: false, again, clock }
    }

    pub(super) fn make_safe(&mut self) {
        self.command = None;
        if std::mem::take(&mut self.gives) {
            self.device.damp(self.clock.now(), DriveState::Safe);
            // The order may be lost, and the drive's thread may hang.
            self.again.damps();
        }
    }
}

impl CentralCommands {
    pub(super) fn new(central: Tid, guard: Guard<Output>) -> Self {
        Self { central, guard, arms: None, anomaly: Anomaly::default() }
    }

    /// Whether central's commands do not count.
    pub(super) fn is_shut(&self) -> bool {
        self.guard.state() != State::Live
    }

    /// Whether there are signs of manipulation.
    pub(super) const fn is_suspect(&self) -> bool {
        self.anomaly.is_there()
    }

    /// Acknowledges a released stop at both guards: the one that accepts requests obeys it, too.
    pub(super) fn acknowledge_stop(&self) -> Result<(), ArmError> {
        self.guard.acknowledge_stop()?;
        self.arms.as_ref().map_or(Ok(()), Guard::acknowledge_stop)
    }

    /// Looks for an anomaly in the guard's counts, and accepts requests to open the guard while it is
    /// shut.
    ///
    /// # Errors
    /// The requests cannot be guarded, so none is accepted; the next call retries.
    pub(super) fn poll(&mut self, context: &mut AppContext<Drive>) -> io::Result<()> {
        let is_shut = self.is_shut();
        self.anomaly.note(&self.guard.tally(), !is_shut);
        if !is_shut {
            self.arms = None;
        } else if let Some(arms) = &self.arms {
            // It moves nothing by itself. Rejected until one has arrived, against which the next can be
            // counted.
            let _ = arms.arm();
        } else {
            self.arms = Some(context.guard::<Arm, _>(self.central, (), |_, _| {})?);
        }
        Ok(())
    }

    /// Opens the guard for central's commands again, if the conditions hold. `state` is the drive's.
    pub(super) fn arm(&mut self, arm: &Delivery<Arm>, state: DriveState) -> Armed {
        if !self.is_shut() {
            return Armed::Before;
        }
        // Rejected in WALK: the tick that makes the drive safe has not run yet, and an old intention of
        // central may be obsolete. Rejected, too, until eight good commands in a row have arrived, and if the
        // request was sent before central knew of the manipulation.
        self.anomaly.note(&self.guard.tally(), false);
        let is_known = arm.suspect || !self.anomaly.is_there();
        let is_old = arm.is_older_than(SILENCE_MAX);
        if state == DriveState::Walk || is_old || !is_known || self.guard.arm().is_err() {
            return Armed::Refused;
        }
        self.anomaly.forget();
        // Other requests that are in flight answer earlier reports.
        self.arms = None;
        // The device may be in a ramp to zero.
        let _ = self.guard.apply(|output| output.gives = true);
        Armed::Now
    }
}

#[cfg(test)]
mod tests {
    use sinew::contracts::{Closure, CommandedOutput, ContractReport, ContractsReport};
    use sinew::prelude::{AppAddress, NodeAddress, NodeConfig, Payload};

    use super::*;

    fn micros(time: Duration) -> u64 {
        u64::try_from(time.as_micros()).expect("less than a minute")
    }

    /// The output of a drive for commands of this type.
    fn output<P: Payload>(drive: Tid) -> CommandedOutput {
        let protection = P::PROTECTION.expect("it is protected");
        CommandedOutput {
            receiver: drive,
            receiver_name: Some("knee.drive".to_owned()),
            sender: Tid::new(NodeAddress::new(1), AppAddress::new(0x1001)),
            sender_name: Some(GAIT.to_owned()),
            sender_node: Some("central".to_owned()),
            kind_name: P::NAME.to_owned(),
            within_us: micros(protection.within),
            age_max_us: micros(protection.age_max),
            measured_us: None,
        }
    }

    #[test]
    fn contract_closes_with_both_guards_and_default_settings() {
        let drive = Tid::new(NodeAddress::new(2), AppAddress::new(0x1001));
        let config = NodeConfig::new("knee");
        let closure = Closure::of(&[ContractsReport {
            node: drive.node,
            name: config.name.clone(),
            slack_us: micros(config.contracts.slack),
            detection_us: 0,
            dry_run: false,
            contracts: vec![ContractReport::new(drive, "knee.drive", &contract())],
            contracts_left_out: 0,
            outputs: vec![output::<GaitState>(drive), output::<Arm>(drive)],
            outputs_left_out: 0,
        }]);
        assert!(closure.closes(), "{closure:?}");
        assert_eq!(closure.rows.len(), 3);
        assert!(closure.rows[0].worst.is_some_and(|worst| worst <= DAMPED_WITHIN), "{closure:?}");
    }
}
