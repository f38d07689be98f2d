//! Tests of `src/robot/drive/order.rs`.

use super::*;

const STATES: [DriveState; 5] =
    [DriveState::Init, DriveState::Ready, DriveState::Walk, DriveState::Safe, DriveState::EStop];
const AT_ONCE: Duration = Duration::ZERO;

#[test]
fn silent_device_with_torque_is_ordered_to_damp() {
    assert_eq!(Order::through_open(None, true), Order::Damp);
    for state in STATES {
        assert_eq!(Order::past_shut(state, None, true, AT_ONCE), Order::Damp, "{state:?}");
    }
    assert_eq!(Order::through_open(None, false), Order::Nothing, "a device at rest is left as it is");
    assert_eq!(Order::past_shut(DriveState::Init, None, false, AT_ONCE), Order::Nothing);
}

#[test]
fn delayed_torque_is_not_sent_past_a_shut_guard() {
    for state in STATES {
        let late = Order::past_shut(state, Some(20.0), true, RAMP_AGE_MAX);
        assert_eq!(late, Order::Damp, "{state:?}");
    }
    let young = RAMP_AGE_MAX.saturating_sub(Duration::from_nanos(1));
    for state in [DriveState::Init, DriveState::Ready, DriveState::EStop] {
        assert_eq!(Order::past_shut(state, Some(20.0), true, young), Order::Torque(20.0), "{state:?}");
        assert_eq!(Order::past_shut(state, Some(0.0), true, RAMP_AGE_MAX), Order::Torque(0.0), "{state:?}");
    }
}
