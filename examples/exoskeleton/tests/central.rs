//! Central: what it does about an e-stop, a loss, and a drive that does not help.

use exoskeleton::central::{CentralConfig, CentralCore, CentralInput, Resume, StillStopped, bit};
use exoskeleton::control::faults::FaultBits;
use exoskeleton::intention::Intention;
use exoskeleton::joint::Joint;
use exoskeleton::message::{DriveState, DriveStatus, FootLoad, GaitMode, GaitState, JointSample};

const MS: u64 = 1_000_000;

/// A leg that walks as intended, heard by central.
struct Walk {
    central: CentralCore,
    intention: Intention,
    ms: u64,
    /// What the drives say; none: nothing.
    says: [Option<(DriveState, FaultBits)>; 3],
}

impl Walk {
    fn new(resume: Resume) -> Self {
        let central = CentralCore::new(CentralConfig { resume, ..CentralConfig::default() });
        let says = [Some((DriveState::Ready, FaultBits(0))); 3];
        Self { central, intention: Intention::from_curves(3), ms: 0, says }
    }

    /// A central that was released and lets the drives assist.
    fn begun(resume: Resume) -> Self {
        let mut walk = Self::new(resume);
        walk.hear(10);
        walk.central.release().expect("nobody pressed the e-stop");
        walk.hear(9_990);
        walk.says = [Some((DriveState::Walk, FaultBits(0))); 3];
        assert_eq!(walk.hear(10).mode, GaitMode::Walk);
        walk
    }

    /// Milliseconds in which central hears everybody; the last state.
    fn hear(&mut self, ms: u64) -> GaitState {
        (0..ms).map(|_| self.tick(true)).last().flatten().expect("all parts are there")
    }

    fn hear_nothing(&mut self, ms: u64) -> Option<GaitMode> {
        (0..ms).map(|_| self.tick(false)).last().flatten().map(|state| state.mode)
    }

    fn tick(&mut self, heard: bool) -> Option<GaitState> {
        self.ms += 1;
        let (t_ns, seq) = (self.ms * MS, self.ms as u32);
        for (joint, says) in Joint::ALL.into_iter().zip(self.says) {
            let Some((state, faults)) = says.filter(|_| seq.is_multiple_of(5)) else { continue };
            let status = DriveStatus {
                seq,
                t_ns,
                state,
                faults: faults.0,
                torque_nm: 0.0,
                age_max_us: 0,
                misses: 0,
                commands_taken: 0,
                commands_refused: 0,
            };
            self.central.drive_heard(joint, &status);
        }
        let intended = self.intention.at(self.ms as f64 * 1e-3);
        let samples = Joint::ALL.map(|joint| JointSample {
            seq,
            t_ns,
            angle_rad: intended.angle_rad[joint.index()] as f32,
            velocity_rad_s: 0.0,
            torque_nm: 0.0,
            temperature_c: 30,
            flags: 0,
        });
        let load_n = intended.vertical_load_bw * 80.0 * 9.81;
        let load = FootLoad { seq, t_ns, heel_n: load_n as f32, toe_n: 0.0 };
        let input = CentralInput { samples: samples.each_ref().map(Some), load: Some(&load) };
        self.central.tick(t_ns, if heard { &input } else { &EMPTY })
    }
}

const EMPTY: CentralInput<'_> = CentralInput { samples: [None; 3], load: None };

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
