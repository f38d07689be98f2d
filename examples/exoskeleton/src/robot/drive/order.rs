//! What the device is told in a tick, by what the core computed and by whether central's word still counts.

use sinew::prelude::Duration;

use crate::message::DriveState;

/// Oldest ramp to zero that goes past a shut guard. A thread that was held up for longer may bring a torque that its device was told to
/// leave meanwhile.
const RAMP_AGE_MAX: Duration = Duration::from_millis(2);

/// What the device is told.
#[derive(Clone, Copy, Debug, PartialEq)]
pub(super) enum Order {
    /// To give this torque, Nm.
    Torque(f64),
    /// To damp by itself. Said in each tick, as one may be lost.
    Damp,
    /// Nothing: it gives nothing that this drive knows of.
    Nothing,
}

impl Order {
    /// Through the open guard. A device that `gives` a torque and is not heard any more cannot be ramped, so it damps: central's word
    /// keeps the guard open, and nobody else would tell it.
    pub(super) fn through_open(command_nm: Option<f64>, gives: bool) -> Self {
        match command_nm {
            Some(torque_nm) => Self::Torque(torque_nm),
            None => Self::unheard(gives),
        }
    }

    /// Past the shut one, `age` after the torque was computed: what is on its way to zero goes on, as long as it is young.
    pub(super) fn past_shut(state: DriveState, command_nm: Option<f64>, gives: bool, age: Duration) -> Self {
        match (state, command_nm) {
            (DriveState::Walk | DriveState::Safe, _) => Self::Damp,
            (DriveState::Init | DriveState::Ready | DriveState::EStop, None) => Self::unheard(gives),
            (DriveState::Init | DriveState::Ready | DriveState::EStop, Some(torque_nm)) => {
                if torque_nm == 0.0 || age < RAMP_AGE_MAX { Self::Torque(torque_nm) } else { Self::Damp }
            }
        }
    }

    const fn unheard(gives: bool) -> Self {
        if gives { Self::Damp } else { Self::Nothing }
    }
}

#[cfg(test)]
mod tests {
    use super::*;

    const STATES: [DriveState; 5] =
        [DriveState::Init, DriveState::Ready, DriveState::Walk, DriveState::Safe, DriveState::EStop];
    const AT_ONCE: Duration = Duration::ZERO;

    #[test]
    fn device_that_gives_a_torque_and_is_not_heard_is_told_to_damp_whatever_the_state_and_the_guard() {
        assert_eq!(Order::through_open(None, true), Order::Damp);
        for state in STATES {
            assert_eq!(Order::past_shut(state, None, true, AT_ONCE), Order::Damp, "{state:?}");
        }
        assert_eq!(Order::through_open(None, false), Order::Nothing, "a device at rest is left as it is");
        assert_eq!(Order::past_shut(DriveState::Init, None, false, AT_ONCE), Order::Nothing);
    }

    #[test]
    fn torque_that_was_held_up_on_its_way_past_a_shut_guard_is_not_given() {
        for state in STATES {
            let late = Order::past_shut(state, Some(20.0), true, RAMP_AGE_MAX);
            assert_eq!(late, Order::Damp, "{state:?}");
        }
        let young = RAMP_AGE_MAX.saturating_sub(Duration::from_nanos(1));
        for state in [DriveState::Init, DriveState::Ready, DriveState::EStop] {
            assert_eq!(Order::past_shut(state, Some(20.0), true, young), Order::Torque(20.0), "{state:?}");
            assert_eq!(
                Order::past_shut(state, Some(0.0), true, RAMP_AGE_MAX),
                Order::Torque(0.0),
                "{state:?}"
            );
        }
    }
}
