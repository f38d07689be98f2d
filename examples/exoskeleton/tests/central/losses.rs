//! What central does about an e-stop, a loss, and a drive that does not help.

use exoskeleton::central::{Resume, StillStopped, bit};
use exoskeleton::control::faults::FaultBits;
use exoskeleton::joint::Joint;
use exoskeleton::message::{DriveState, GaitMode};

use crate::{MS, walk::Walk};

#[test]
fn e_stop_is_latched_and_only_a_reset_and_a_new_release_lead_back_to_walking() {
    let mut walk = Walk::begun(Resume::ByItself);
    walk.central.stop();
    assert_eq!(walk.hear(1).mode, GaitMode::Stop);
    assert_eq!(walk.central.release(), Err(StillStopped));
    assert_eq!(walk.hear(3_000).mode, GaitMode::Stop);
    walk.central.reset();
    assert_eq!(walk.hear(3_000).mode, GaitMode::Hold);
    walk.central.release().expect("it was reset");
    assert_eq!(walk.hear(2).mode, GaitMode::Sync);
}

#[test]
fn e_stop_holds_through_the_loss_and_return_of_parts() {
    let mut walk = Walk::begun(Resume::ByItself);
    walk.central.stop();
    walk.central.node_lost(Joint::Knee);
    assert_eq!(walk.hear_nothing(500), Some(GaitMode::Stop));
    walk.central.node_found(Joint::Knee);
    assert_eq!(walk.hear(500).mode, GaitMode::Stop);
}

#[test]
fn reset_without_an_e_stop_changes_nothing() {
    let mut walk = Walk::begun(Resume::ByItself);
    walk.central.reset();
    assert_eq!(walk.hear(100).mode, GaitMode::Walk);
}

#[test]
fn drive_that_was_stopped_alone_stops_the_whole_leg() {
    let mut walk = Walk::begun(Resume::ByItself);
    walk.says[Joint::Hip.index()] = Some((DriveState::EStop, FaultBits::STOPPED));
    assert_eq!(walk.hear(10).mode, GaitMode::Stop);
}

#[test]
fn new_life_of_central_releases_nothing_while_a_drive_is_still_stopped() {
    let mut walk = Walk::new(Resume::ByItself);
    walk.says[Joint::Ankle.index()] = Some((DriveState::EStop, FaultBits::STOPPED));
    // Released before it could hear of the stop, as the coordinator may.
    walk.central.release().expect("it has heard of nothing yet");
    assert_eq!(walk.hear(500).mode, GaitMode::Stop);
    walk.central.reset();
    assert_eq!(walk.hear(500).mode, GaitMode::Hold);
    assert_eq!(walk.central.release(), Err(StillStopped));
    walk.says[Joint::Ankle.index()] = Some((DriveState::Ready, FaultBits(0)));
    assert_eq!(walk.hear(500).mode, GaitMode::Hold);
    walk.central.release().expect("the drive was reset");
    assert_eq!(walk.hear(2).mode, GaitMode::Sync);
}

#[test]
fn after_a_loss_nothing_moves_until_the_operator_releases_anew() {
    let mut walk = Walk::begun(Resume::ByOperator);
    assert_eq!(walk.hear_nothing(1_000), Some(GaitMode::Safe));
    assert_eq!(walk.hear(5_000).mode, GaitMode::Hold);
    walk.central.release().expect("nobody pressed the e-stop");
    assert_eq!(walk.hear(2).mode, GaitMode::Sync);
    assert_eq!(walk.hear(9_000).mode, GaitMode::Walk);
}

#[test]
fn after_a_loss_walking_goes_on_by_itself_where_that_was_chosen() {
    let mut walk = Walk::begun(Resume::ByItself);
    assert_eq!(walk.hear_nothing(1_000), Some(GaitMode::Safe));
    assert_eq!(walk.hear(2).mode, GaitMode::Sync);
}

#[test]
fn hiccup_of_a_host_needs_no_new_release() {
    let mut walk = Walk::begun(Resume::ByOperator);
    assert_eq!(walk.hear_nothing(200), Some(GaitMode::Safe));
    assert_eq!(walk.hear(1).mode, GaitMode::Walk);
}

#[test]
fn drive_that_falls_silent_is_flagged_as_degraded_and_the_others_walk_on() {
    let mut walk = Walk::begun(Resume::ByOperator);
    walk.says[Joint::Knee.index()] = None;
    let state = walk.hear(20);
    assert_eq!((state.mode, state.degraded), (GaitMode::Walk, 0));
    let state = walk.hear(20);
    assert_eq!((state.mode, state.degraded), (GaitMode::Walk, bit(Joint::Knee)));
    walk.says[Joint::Knee.index()] = Some((DriveState::Walk, FaultBits(0)));
    assert_eq!(walk.hear(10).degraded, 0);
}

#[test]
fn drive_whose_end_is_told_is_degraded_at_once_until_its_next_life_assists() {
    let mut walk = Walk::begun(Resume::ByOperator);
    walk.hear(1);
    walk.central.drive_ended(Joint::Knee, walk.ms * MS);
    walk.says[Joint::Knee.index()] = None;
    let state = walk.hear(1);
    assert_eq!((state.mode, state.degraded), (GaitMode::Walk, bit(Joint::Knee)));
    walk.says[Joint::Knee.index()] = Some((DriveState::Init, FaultBits(0)));
    assert_eq!(walk.hear(10).degraded, bit(Joint::Knee));
    walk.says[Joint::Knee.index()] = Some((DriveState::Walk, FaultBits(0)));
    assert_eq!(walk.hear(10).degraded, 0);
}

#[test]
fn last_words_of_a_dead_drive_are_no_sign_of_the_next() {
    let mut walk = Walk::begun(Resume::ByOperator);
    // It is told a little later than the words that are still on their way were sent.
    walk.central.drive_ended(Joint::Knee, (walk.ms + 10) * MS);
    assert_eq!(walk.hear(9).degraded, bit(Joint::Knee));
    assert_eq!(walk.hear(11).degraded, 0);
}

#[test]
fn drive_that_does_not_assist_though_it_speaks_is_degraded_too() {
    let mut walk = Walk::begun(Resume::ByOperator);
    walk.says[Joint::Hip.index()] = Some((DriveState::Safe, FaultBits::INPUT_LOST));
    assert_eq!(walk.hear(40).degraded, bit(Joint::Hip));
}

#[test]
fn standing_still_of_central_itself_degrades_nobody() {
    let mut walk = Walk::begun(Resume::ByOperator);
    walk.ms += 150;
    assert_eq!(walk.hear(2).degraded, 0);
}

#[test]
fn stop_is_heeded_whatever_is_known_of_its_age_and_of_whichever_life_it_is() {
    // Of a clock that was not measured yet
    let mut walk = Walk::begun(Resume::ByItself);
    walk.hears_late(Joint::Hip, (DriveState::EStop, FaultBits::STOPPED), (0, None));
    assert_eq!(walk.hear(1).mode, GaitMode::Stop);
    // Of a life that is over
    let mut walk = Walk::begun(Resume::ByItself);
    walk.central.drive_ended(Joint::Hip, walk.ms * MS);
    walk.hears_late(Joint::Hip, (DriveState::EStop, FaultBits::STOPPED), ((walk.ms - 1_000) * MS, Some(0)));
    assert_eq!(walk.hear(1).mode, GaitMode::Stop);
}

#[test]
fn word_that_may_have_been_said_before_the_stop_takes_nothing_back() {
    // Given: a leg that is held, and a drive that was stopped
    let mut walk = Walk::new(Resume::ByItself);
    walk.hear(10);
    let ready = (DriveState::Ready, FaultBits(0));
    walk.says[Joint::Hip.index()] = None;
    let (t_ns, stopped) = (walk.ms * MS, (DriveState::EStop, FaultBits::STOPPED));
    walk.hears_late(Joint::Hip, stopped, (t_ns, Some(0)));
    walk.hear(10);
    // When: older words of it come, and such of which nobody knows
    for (of_ns, error_ns) in
        [(t_ns - MS, Some(0)), (t_ns + 3 * MS, Some(3 * MS)), (t_ns + 3 * MS, None), (0, None)]
    {
        walk.hears_late(Joint::Hip, ready, (of_ns, error_ns));
        assert_eq!(walk.central.release(), Err(StillStopped), "{of_ns} {error_ns:?}");
    }
    // Then: one does that was surely said later
    walk.hears_late(Joint::Hip, ready, (t_ns + 4 * MS, Some(3 * MS)));
    walk.central.release().expect("the drive was reset");
}

#[test]
fn drive_whose_words_are_of_unknown_age_is_degraded() {
    let mut walk = Walk::begun(Resume::ByOperator);
    walk.says[Joint::Knee.index()] = None;
    for _ in 0..40 {
        walk.hear(1);
        walk.hears_late(Joint::Knee, (DriveState::Walk, FaultBits(0)), (walk.ms * MS, None));
    }
    assert_eq!(walk.hear(1).degraded, bit(Joint::Knee));
}
