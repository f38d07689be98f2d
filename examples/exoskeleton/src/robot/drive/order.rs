//! The order for the device in a tick, from the core's result and whether central's commands still count.

use exoskeleton_model::message::DriveState;
use sinew::prelude::Duration;

/// Maximum age of a ramp to zero that is sent past a shut guard. A thread that was delayed for longer may
/// bring a torque that the device was ordered to give up meanwhile.
const RAMP_AGE_MAX: Duration = Duration::from_millis(2);

/// An order for the device.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Order {
    /// Apply this torque, Nm.
    Torque(f64),
    /// Damp by itself. Sent in each tick, as one may be lost.
    Damp,
    /// No order: as far as this drive knows, the device gives no torque.
    Nothing,
}

impl Order {
    /// The order through the open guard. A device that `gives` a torque and sends no readings cannot be
    /// ramped, so it damps: central's commands keep the guard open, so no other thread would order that.
    pub(super) fn through_open(command_nm: Option<f64>, gives: bool) -> Self {
        match command_nm {
            Some(torque_nm) => Self::Torque(torque_nm),
            None => Self::without_input(gives),
        }
    }

    /// The order past the shut guard, `age` after the torque was computed: a ramp to zero continues while it
    /// is young.
    pub(super) fn past_shut(state: DriveState, command_nm: Option<f64>, gives: bool, age: Duration) -> Self {
        match (state, command_nm) {
            (DriveState::Walk | DriveState::Safe, _) => Self::Damp,
            (DriveState::Init | DriveState::Ready | DriveState::EStop, None) => Self::without_input(gives),
            (DriveState::Init | DriveState::Ready | DriveState::EStop, Some(torque_nm)) => {
                if torque_nm == 0.0 || age < RAMP_AGE_MAX { Self::Torque(torque_nm) } else { Self::Damp }
            }
        }
    }

    const fn without_input(gives: bool) -> Self {
        if gives { Self::Damp } else { Self::Nothing }
    }
}

#[cfg(test)]
#[path = "../../../tests/unit/order.rs"]
mod tests;
