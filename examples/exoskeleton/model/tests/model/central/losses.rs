//! Central's reaction to an e-stop, a loss, and a drive that does not assist.

use exoskeleton_model::central::{EStopLatchedError, Resume, bit};
use exoskeleton_model::control::faults::FaultBits;
use exoskeleton_model::joint::Joint;
use exoskeleton_model::message::{DriveState, GaitMode};

use super::{MS, walk::Walk};

#[test]
fn e_stop_is_latched_until_reset_and_new_release() {
    let mut walk = Walk::begun(Resume::ByItself);
    walk.central.stop();
    assert_eq!(walk.receive(1).mode, GaitMode::Stop);
    assert_eq!(walk.central.release(), Err(EStopLatchedError));
    assert_eq!(walk.receive(3_000).mode, GaitMode::Stop);
    walk.central.reset();
    assert_eq!(walk.receive(3_000).mode, GaitMode::Hold);
    walk.central.release().expect("it was reset");
    assert_eq!(walk.receive(2).mode, GaitMode::Sync);
}

#[test]
fn e_stop_survives_the_return_of_parts() {
    let mut walk = Walk::begun(Resume::ByItself);
    walk.central.stop();
    walk.central.node_lost(Joint::Knee);
    assert_eq!(walk.receive_nothing(500), Some(GaitMode::Stop));
    walk.central.node_found(Joint::Knee);
    assert_eq!(walk.receive(500).mode, GaitMode::Stop);
}

#[test]
fn reset_without_an_e_stop_changes_nothing() {
    let mut walk = Walk::begun(Resume::ByItself);
    walk.central.reset();
    assert_eq!(walk.receive(100).mode, GaitMode::Walk);
}

#[test]
fn drive_that_was_stopped_alone_stops_the_whole_leg() {
    let mut walk = Walk::begun(Resume::ByItself);
    walk.reports[Joint::Hip.index()] = Some((DriveState::EStop, FaultBits::STOPPED));
    assert_eq!(walk.receive(10).mode, GaitMode::Stop);
}

#[test]
fn restarted_central_does_not_release_a_stopped_drive() {
    let mut walk = Walk::new(Resume::ByItself);
    walk.reports[Joint::Ankle.index()] = Some((DriveState::EStop, FaultBits::STOPPED));
    // Released before it could receive the stop, as the coordinator may do.
    walk.central.release().expect("it has received no report yet");
    assert_eq!(walk.receive(500).mode, GaitMode::Stop);
    walk.central.reset();
    assert_eq!(walk.receive(500).mode, GaitMode::Hold);
    assert_eq!(walk.central.release(), Err(EStopLatchedError));
    walk.reports[Joint::Ankle.index()] = Some((DriveState::Ready, FaultBits(0)));
    assert_eq!(walk.receive(500).mode, GaitMode::Hold);
    walk.central.release().expect("the drive was reset");
    assert_eq!(walk.receive(2).mode, GaitMode::Sync);
}

#[test]
fn after_a_loss_nothing_moves_before_a_new_release() {
    let mut walk = Walk::begun(Resume::ByOperator);
    assert_eq!(walk.receive_nothing(1_000), Some(GaitMode::Safe));
    assert_eq!(walk.receive(5_000).mode, GaitMode::Hold);
    walk.central.release().expect("the e-stop was not pressed");
    assert_eq!(walk.receive(2).mode, GaitMode::Sync);
    assert_eq!(walk.receive(9_000).mode, GaitMode::Walk);
}

#[test]
fn after_a_loss_walking_resumes_by_itself_if_configured() {
    let mut walk = Walk::begun(Resume::ByItself);
    assert_eq!(walk.receive_nothing(1_000), Some(GaitMode::Safe));
    assert_eq!(walk.receive(2).mode, GaitMode::Sync);
}

#[test]
fn hiccup_of_a_host_needs_no_new_release() {
    let mut walk = Walk::begun(Resume::ByOperator);
    assert_eq!(walk.receive_nothing(200), Some(GaitMode::Safe));
    assert_eq!(walk.receive(1).mode, GaitMode::Walk);
}

#[test]
fn silent_drive_is_degraded_and_the_others_walk_on() {
    let mut walk = Walk::begun(Resume::ByOperator);
    walk.reports[Joint::Knee.index()] = None;
    let state = walk.receive(20);
    assert_eq!((state.mode, state.degraded), (GaitMode::Walk, 0));
    let state = walk.receive(20);
    assert_eq!((state.mode, state.degraded), (GaitMode::Walk, bit(Joint::Knee)));
    walk.reports[Joint::Knee.index()] = Some((DriveState::Walk, FaultBits(0)));
    assert_eq!(walk.receive(10).degraded, 0);
}

#[test]
fn ended_drive_is_degraded_until_its_next_incarnation_assists() {
    let mut walk = Walk::begun(Resume::ByOperator);
    walk.receive(1);
    walk.central.drive_ended(Joint::Knee, walk.ms * MS);
    walk.reports[Joint::Knee.index()] = None;
    let state = walk.receive(1);
    assert_eq!((state.mode, state.degraded), (GaitMode::Walk, bit(Joint::Knee)));
    walk.reports[Joint::Knee.index()] = Some((DriveState::Init, FaultBits(0)));
    assert_eq!(walk.receive(10).degraded, bit(Joint::Knee));
    walk.reports[Joint::Knee.index()] = Some((DriveState::Walk, FaultBits(0)));
    assert_eq!(walk.receive(10).degraded, 0);
}

#[test]
fn late_status_of_a_dead_drive_is_ignored() {
    let mut walk = Walk::begun(Resume::ByOperator);
    // The end is reported a little after the sending time of the messages that are still in flight.
    walk.central.drive_ended(Joint::Knee, (walk.ms + 10) * MS);
    assert_eq!(walk.receive(9).degraded, bit(Joint::Knee));
    assert_eq!(walk.receive(11).degraded, 0);
}

#[test]
fn reporting_drive_that_does_not_assist_is_degraded() {
    let mut walk = Walk::begun(Resume::ByOperator);
    walk.reports[Joint::Hip.index()] = Some((DriveState::Safe, FaultBits::INPUT_LOST));
    assert_eq!(walk.receive(40).degraded, bit(Joint::Hip));
}

#[test]
fn stall_of_central_degrades_no_drive() {
    let mut walk = Walk::begun(Resume::ByOperator);
    walk.ms += 150;
    assert_eq!(walk.receive(2).degraded, 0);
}

#[test]
fn stop_counts_at_any_age_and_of_any_incarnation() {
    // With an unmeasured clock
    let mut walk = Walk::begun(Resume::ByItself);
    walk.receive_late(Joint::Hip, (DriveState::EStop, FaultBits::STOPPED), (0, None));
    assert_eq!(walk.receive(1).mode, GaitMode::Stop);
    // Of an incarnation that has ended
    let mut walk = Walk::begun(Resume::ByItself);
    walk.central.drive_ended(Joint::Hip, walk.ms * MS);
    walk.receive_late(Joint::Hip, (DriveState::EStop, FaultBits::STOPPED), ((walk.ms - 1_000) * MS, Some(0)));
    assert_eq!(walk.receive(1).mode, GaitMode::Stop);
}

#[test]
fn status_older_than_the_stop_does_not_clear_it() {
    // given: a leg that is held, and a drive that was stopped
    let mut walk = Walk::new(Resume::ByItself);
    walk.receive(10);
    let ready = (DriveState::Ready, FaultBits(0));
    walk.reports[Joint::Hip.index()] = None;
    let (t_ns, stopped) = (walk.ms * MS, (DriveState::EStop, FaultBits::STOPPED));
    walk.receive_late(Joint::Hip, stopped, (t_ns, Some(0)));
    walk.receive(10);
    // when: older reports of it arrive, and reports of unknown age
    for (of_ns, error_ns) in
        [(t_ns - MS, Some(0)), (t_ns + 3 * MS, Some(3 * MS)), (t_ns + 3 * MS, None), (0, None)]
    {
        walk.receive_late(Joint::Hip, ready, (of_ns, error_ns));
        assert_eq!(walk.central.release(), Err(EStopLatchedError), "{of_ns} {error_ns:?}");
    }
    // then: a report that was certainly sent later releases it
    walk.receive_late(Joint::Hip, ready, (t_ns + 4 * MS, Some(3 * MS)));
    walk.central.release().expect("the drive was reset");
}

#[test]
fn drive_with_statuses_of_unknown_age_is_degraded() {
    let mut walk = Walk::begun(Resume::ByOperator);
    walk.reports[Joint::Knee.index()] = None;
    for _ in 0..40 {
        walk.receive(1);
        walk.receive_late(Joint::Knee, (DriveState::Walk, FaultBits(0)), (walk.ms * MS, None));
    }
    assert_eq!(walk.receive(1).degraded, bit(Joint::Knee));
}
