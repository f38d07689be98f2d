//! The drive: its invariants under every input, and its state machine.

use exoskeleton_model::control::drive::{DriveConfig, DriveCore, DriveOutput, ResetError};
use exoskeleton_model::control::faults::FaultBits;
use exoskeleton_model::control::torque_law::TorqueLaw;
use exoskeleton_model::joint::Joint;
use exoskeleton_model::message::{DriveState, GaitMode, GaitState, JointSample, Stance, TorqueSet};
use proptest::prelude::*;

const MS: u64 = 1_000_000;

fn sample(ms: u64) -> JointSample {
    JointSample {
        seq: ms as u32,
        t_ns: ms * MS,
        t_error_ns: Some(0),
        angle_rad: 0.2,
        velocity_rad_s: 1.5,
        torque_nm: 0.0,
        temperature_c: 30,
        flags: 0,
    }
}

fn gait(ms: u64, mode: GaitMode) -> GaitState {
    GaitState {
        seq: ms as u32,
        t_ns: ms * MS,
        t_error_ns: Some(0),
        phase: 0.5,
        phase_rate_hz: 0.75,
        stance: Stance::Stance,
        mode,
        confidence: 1.0,
        epoch: 1,
        degraded: 0,
    }
}

fn drive() -> DriveCore {
    DriveCore::new(DriveConfig::standard(Joint::Ankle))
}

/// Runs ticks each millisecond of `range` with fresh inputs of `mode`; returns the last output.
fn feed(drive: &mut DriveCore, range: std::ops::Range<u64>, mode: GaitMode) -> DriveOutput {
    range
        .map(|ms| drive.tick(ms * MS, Some(&sample(ms)), Some(&gait(ms, mode))))
        .last()
        .expect("a range that is not empty")
}

/// A drive that has walked for a second, at full assistance.
fn walking() -> DriveCore {
    let mut drive = drive();
    let output = feed(&mut drive, 0..1000, GaitMode::Walk);
    assert_eq!((output.state, output.assist_gain), (DriveState::Walk, 1.0));
    assert!(output.command_nm.is_some_and(|torque| torque < -30.0));
    drive
}

#[test]
fn torque_is_exactly_zero_until_walking_is_released() {
    let mut drive = drive();
    for (from, mode) in
        [(0, GaitMode::Hold), (100, GaitMode::Sync), (200, GaitMode::Safe), (300, GaitMode::Hold)]
    {
        for ms in from..from + 100 {
            let output = drive.tick(ms * MS, Some(&sample(ms)), Some(&gait(ms, mode)));
            assert_eq!(output.command_nm.map(f64::to_bits), Some(0.0_f64.to_bits()), "{mode:?}");
        }
    }
}

#[test]
fn drive_without_a_device_reading_stays_silent() {
    let mut drive = drive();
    assert_eq!(drive.tick(0, None, Some(&gait(0, GaitMode::Walk))).command_nm, None);
}

#[test]
fn distrusted_gait_makes_the_drive_safe_at_once() {
    let mut drive = walking();
    drive.distrust_gait();
    let last = gait(999, GaitMode::Walk);
    let output = drive.tick(1000 * MS, Some(&sample(1000)), Some(&last));
    assert_eq!(output.state, DriveState::Safe, "earlier inputs do not count again");
    let output = drive.tick(1001 * MS, Some(&sample(1001)), Some(&gait(1001, GaitMode::Walk)));
    assert_eq!(output.state, DriveState::Walk, "a new one does");
}

#[test]
fn drive_resumes_from_the_torque_of_a_damping_device() {
    let mut drive = walking();
    drive.distrust_gait();
    drive.let_device_damp(1000 * MS);
    assert_eq!(drive.tick(1000 * MS, None, None).command_nm, None, "it is not known yet");
    let before = JointSample { seq: 1000, t_ns: 999 * MS + MS / 2, torque_nm: 25.0, ..sample(999) };
    assert_eq!(drive.tick(1000 * MS + MS / 2, Some(&before), None).command_nm, None, "it gave that before");
    // Repeated in each tick, as an order may be lost: a reading that takes longer than a tick still counts as
    // later.
    drive.let_device_damp(1001 * MS);
    let damping = JointSample { t_ns: 1000 * MS + MS / 2, torque_nm: -1.5, ..sample(1001) };
    let torque_nm = drive.tick(1002 * MS, Some(&damping), None).command_nm.expect("it is known");
    assert!((torque_nm + 1.5).abs() <= 2.0, "{torque_nm} after what was -1.5");
}

#[test]
fn old_gait_state_makes_the_drive_safe_at_once() {
    let mut drive = walking();
    for ms in 1000..1009 {
        assert_eq!(drive.tick(ms * MS, Some(&sample(ms)), None).state, DriveState::Walk, "{ms}");
    }
    assert_eq!(drive.tick(1009 * MS, Some(&sample(1009)), None).state, DriveState::Walk);
    assert_eq!(drive.tick(1009 * MS + 1, Some(&sample(1009)), None).state, DriveState::Safe);
    assert_eq!(drive.counters().safe_entries, 1);
}

#[test]
fn old_joint_sample_ramps_the_torque_to_zero() {
    let mut drive = walking();
    let outputs: Vec<DriveOutput> =
        (1000..1100).map(|ms| drive.tick(ms * MS, None, Some(&gait(ms, GaitMode::Walk)))).collect();
    assert_eq!(outputs[9].state, DriveState::Walk);
    assert_eq!(outputs[10].state, DriveState::Safe);
    assert_eq!(outputs[99].command_nm, Some(0.0));
}

#[test]
fn safe_torque_ends_as_soft_damping() {
    let mut drive = walking();
    let output = feed(&mut drive, 1000..1100, GaitMode::Safe);
    assert_eq!(output.state, DriveState::Safe);
    assert!((output.command_nm.unwrap() + 1.5).abs() < 1e-9);
}

#[test]
fn assistance_comes_back_over_half_a_second() {
    let mut drive = walking();
    feed(&mut drive, 1000..1100, GaitMode::Safe);
    let early = feed(&mut drive, 1100..1350, GaitMode::Walk);
    assert!((early.assist_gain - 0.5).abs() < 0.01, "{}", early.assist_gain);
    assert!(early.command_nm.unwrap().abs() < 30.0);
    assert!(feed(&mut drive, 1350..1700, GaitMode::Walk).assist_gain == 1.0);
}

#[test]
fn emergency_stop_is_fast_and_needs_a_reset() {
    let mut drive = walking();
    drive.emergency_stop();
    let output = feed(&mut drive, 1000..1050, GaitMode::Walk);
    assert_eq!((output.state, output.command_nm), (DriveState::EStop, Some(0.0)));
    assert_eq!(feed(&mut drive, 1050..1500, GaitMode::Walk).state, DriveState::EStop);
    drive.reset(1500 * MS).expect("at rest");
    assert_eq!(feed(&mut drive, 1500..1510, GaitMode::Hold).state, DriveState::Ready);
}

#[test]
fn insane_inputs_are_counted_and_never_reach_the_torque() {
    let mut drive = walking();
    let bad = [
        JointSample { angle_rad: f32::NAN, ..sample(1000) },
        JointSample { velocity_rad_s: f32::INFINITY, ..sample(1001) },
        JointSample { angle_rad: 40.0, ..sample(1002) },
        JointSample { seq: 3, ..sample(1003) },
        sample(900),
        JointSample { t_ns: 5000 * MS, ..sample(1005) },
    ];
    for (ms, bad) in (1000..).zip(&bad) {
        let output = drive.tick(ms * MS, Some(bad), Some(&gait(ms, GaitMode::Walk)));
        assert!(output.command_nm.unwrap().is_finite());
    }
    let refused = drive.counters().samples_refused;
    assert_eq!(
        (
            refused.not_finite,
            refused.out_of_range,
            refused.old_sequence,
            refused.too_old,
            refused.from_future
        ),
        (2, 1, 1, 1, 1)
    );
    let bad_gait = GaitState { phase: f32::NAN, ..gait(1006, GaitMode::Walk) };
    let old_epoch = GaitState { epoch: 0, ..gait(1007, GaitMode::Walk) };
    drive.tick(1006 * MS, None, Some(&bad_gait));
    drive.tick(1007 * MS, None, Some(&old_epoch));
    assert_eq!(
        (drive.counters().gait_refused.not_finite, drive.counters().gait_refused.old_sequence),
        (1, 1)
    );
}

#[test]
fn restarted_sensor_is_accepted_once_old_samples_are_stale() {
    let mut drive = walking();
    for ms in 1000..1020 {
        drive.tick(ms * MS, None, Some(&gait(ms, GaitMode::Safe)));
    }
    let restarted = JointSample { seq: 0, ..sample(1020) };
    let output = drive.tick(1020 * MS, Some(&restarted), Some(&gait(1020, GaitMode::Walk)));
    assert_eq!(output.state, DriveState::Walk);
}

#[test]
fn new_epoch_is_accepted_and_the_old_one_rejected() {
    let mut drive = walking();
    let reborn = GaitState { epoch: 2, seq: 0, ..gait(1000, GaitMode::Hold) };
    assert_eq!(drive.tick(1000 * MS, Some(&sample(1000)), Some(&reborn)).state, DriveState::Ready);
    let ghost = gait(1001, GaitMode::Walk);
    assert_eq!(drive.tick(1001 * MS, Some(&sample(1001)), Some(&ghost)).state, DriveState::Ready);
}

#[test]
fn drive_started_over_a_held_torque_ramps_from_there() {
    let mut drive = drive();
    let held = JointSample { torque_nm: -40.0, ..sample(0) };
    let first = drive.tick(0, Some(&held), None).command_nm.unwrap();
    assert!((first + 40.0).abs() < 2.1, "{first}");
    let later = (1..60).map(|ms| drive.tick(ms * MS, Some(&sample(ms)), None)).last().unwrap();
    assert_eq!(later.command_nm, Some(0.0));
}

#[test]
fn status_has_the_state_and_resets_the_maximum_age() {
    let mut drive = walking();
    drive.tick(1005 * MS, None, None);
    let status = drive.status(1005 * MS);
    assert_eq!((status.state, status.age_max_us), (DriveState::Walk, Some(6000)));
    feed(&mut drive, 1006..1008, GaitMode::Walk);
    assert_eq!(drive.status(1008 * MS).age_max_us, Some(0));
}

/// The drive's own feed-forward at the phase of [`gait`], where the ankle pushes off: about -47 Nm.
fn own_nm() -> f32 {
    TorqueLaw::standard(Joint::Ankle).feed_forward_nm(0.5 + 0.75 * 0.006) as f32
}

fn torque_set(ms: u64, torque_nm: f32) -> TorqueSet {
    TorqueSet { seq: ms as u32, t_ns: ms * MS, t_error_ns: Some(0), torque_nm, epoch: 1 }
}

#[test]
fn external_torque_is_used_while_young_and_near() {
    let mut drive = walking();
    let before = feed(&mut drive, 1000..1001, GaitMode::Walk).command_nm.unwrap();
    assert!(drive.command(1001 * MS, &torque_set(1001, own_nm() + 8.0)));
    let with = feed(&mut drive, 1001..1010, GaitMode::Walk).command_nm.unwrap();
    assert!((with - before - 8.0).abs() < 0.5, "{before} {with}");
    // It was sent once and not again.
    let after = feed(&mut drive, 1010..1030, GaitMode::Walk).command_nm.unwrap();
    assert!((after - before).abs() < 0.1, "{before} {after}");
    assert!(!drive.faults().contains(FaultBits::COMMAND_REFUSED));
}

#[test]
fn insane_external_torques_are_counted_without_effect() {
    let mut drive = walking();
    let before = feed(&mut drive, 1000..1001, GaitMode::Walk).command_nm.unwrap();
    assert!(drive.command(1001 * MS, &torque_set(1001, own_nm())));
    feed(&mut drive, 1001..1007, GaitMode::Walk);
    for bad in [
        torque_set(1002, f32::NAN),
        torque_set(1003, 500.0),
        torque_set(1004, -own_nm()),
        TorqueSet { seq: 900, ..torque_set(1005, own_nm()) },
        TorqueSet { epoch: 0, ..torque_set(1006, own_nm()) },
        TorqueSet { t_ns: 900 * MS, ..torque_set(1007, own_nm()) },
    ] {
        assert!(!drive.command(1007 * MS, &bad), "{bad:?}");
    }
    let refused = drive.counters().commands_refused;
    assert_eq!((refused.not_finite, refused.out_of_range, refused.opposed), (1, 1, 1));
    assert_eq!((refused.old_sequence, refused.too_old, refused.total()), (2, 1, 6));
    assert_eq!(drive.counters().commands_admitted, 1);
    let after = feed(&mut drive, 1007..1012, GaitMode::Walk).command_nm.unwrap();
    assert!((after - before).abs() < 0.1, "{before} {after}");
    assert!(drive.faults().contains(FaultBits::COMMAND_REFUSED));
}

#[test]
fn stop_of_central_latches_while_central_commands_it() {
    let mut drive = walking();
    let output = feed(&mut drive, 1000..1050, GaitMode::Stop);
    assert_eq!((output.state, output.command_nm), (DriveState::EStop, Some(0.0)));
    assert!(drive.faults().contains(FaultBits::STOPPED));
    assert_eq!(drive.reset(1050 * MS), Err(ResetError::CentralStopped));
    assert_eq!(feed(&mut drive, 1050..1100, GaitMode::Walk).state, DriveState::EStop);
    assert_eq!(drive.reset(1100 * MS), Ok(()));
    assert_eq!(drive.faults(), FaultBits(0));
    assert_eq!(feed(&mut drive, 1100..1101, GaitMode::Hold).state, DriveState::Ready);
}

#[test]
fn stop_works_without_a_joint_sample() {
    let mut drive = walking();
    let outputs = (1000..1100).map(|ms| drive.tick(ms * MS, None, Some(&gait(ms, GaitMode::Stop))));
    assert_eq!(outputs.last().map(|output| output.state), Some(DriveState::EStop));
}

#[test]
fn reset_before_the_torque_is_zero_is_rejected() {
    let mut drive = walking();
    drive.emergency_stop();
    feed(&mut drive, 1000..1003, GaitMode::Hold);
    assert_eq!(drive.reset(1003 * MS), Err(ResetError::NotAtRest));
    assert_eq!(drive.state(), DriveState::EStop);
}

#[test]
fn orderly_end_of_a_drive_stops_no_other() {
    let mut drive = walking();
    drive.let_go();
    assert_eq!(feed(&mut drive, 1000..1050, GaitMode::Walk).command_nm, Some(0.0));
    assert!(!drive.faults().contains(FaultBits::STOPPED));
}

#[test]
fn drive_away_alone_is_back_in_200_ms() {
    let mut drive = drive();
    let early = feed(&mut drive, 0..102, GaitMode::Walk);
    assert!((early.assist_gain - 0.5).abs() < 0.02, "{}", early.assist_gain);
    assert!((feed(&mut drive, 102..203, GaitMode::Walk).assist_gain - 1.0).abs() < 1e-9);
}

#[test]
fn frozen_drive_resumes_from_its_devices_torque() {
    let mut drive = walking();
    // The process stands still for 300 ms; its device damps by itself meanwhile and applies 1.5 Nm.
    let thawed = drive.tick(1300 * MS, Some(&sample(1001)), Some(&gait(1001, GaitMode::Walk)));
    assert_eq!((thawed.state, thawed.command_nm), (DriveState::Safe, None));
    assert_eq!(drive.counters().pauses, 1);
    let damping = JointSample { torque_nm: -1.5, ..sample(1301) };
    let output = drive.tick(1301 * MS, Some(&damping), Some(&gait(1301, GaitMode::Walk)));
    assert_eq!(output.state, DriveState::Walk);
    let first = output.command_nm.unwrap();
    assert!((first + 1.5).abs() <= 2.0, "{first}");
}

#[test]
fn late_tick_sends_nothing_until_a_later_sample() {
    // given: a drive with a torque that rises at the rate limit, and a device that is 10 Nm behind
    let mut drive = walking();
    drive.emergency_stop();
    let before = feed(&mut drive, 1000..1010, GaitMode::Hold).command_nm.expect("its inputs have arrived");
    let of_before = JointSample { torque_nm: before as f32 - 10.0, ..sample(1010) };
    // when: its tick is late, with a sample from before it
    let late = drive.tick(1016 * MS, Some(&of_before), None);
    assert_eq!(late.command_nm, None);
    // then: that sample has no effect, nor has another earlier one
    assert_eq!(drive.tick(1017 * MS, Some(&of_before), None).command_nm, None);
    let at_that_time = JointSample { t_ns: 1016 * MS, ..sample(1011) };
    assert_eq!(drive.tick(1017 * MS, Some(&at_that_time), None).command_nm, None);
    let of_after = JointSample { torque_nm: before as f32, ..sample(1017) };
    let torque_nm = drive.tick(1018 * MS, Some(&of_after), None).command_nm.expect("it is known");
    assert!((torque_nm - before).abs() <= 2.0 + 1e-5, "{torque_nm} after {before}");
}

fn any_mode() -> impl Strategy<Value = GaitMode> {
    prop_oneof![
        1 => Just(GaitMode::Hold),
        1 => Just(GaitMode::Sync),
        60 => Just(GaitMode::Walk),
        1 => Just(GaitMode::Safe),
        1 => Just(GaitMode::Stop)
    ]
}

/// Lag of the proptest's device, ns: as long as the plant's.
const DEVICE_LAG_NS: f64 = 5e6;

/// Step of time (ns), a sample and a gait state that may be garbage, and a die for stop and reset.
type AnyTick = (u64, Option<[f32; 2]>, Option<(f32, f32, GaitMode, u32)>, u8);

/// A tick with anything in it.
fn any_tick() -> impl Strategy<Value = AnyTick> {
    let rough = prop_oneof![30 => 0.0f32..1.0, 2 => -1.0f32..2.0, 1 => any::<f32>()];
    let values = [rough.clone(), rough.clone()];
    (
        // Just over the limit of a pause, the least is allowed.
        prop_oneof![12 => 0..2 * MS, 1 => 0..12 * MS, 1 => 6 * MS..7 * MS],
        prop::option::weighted(0.8, values),
        prop::option::weighted(0.8, (rough.clone(), rough, any_mode(), 1u32..3)),
        any::<u8>(),
    )
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 96, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn torque_stays_within_limit_and_rate_for_any_input(
        ticks in prop::collection::vec(any_tick(), 1..500),
        mut walked in any::<bool>()
    ) {
        let mut drive = if walked { walking() } else { drive() };
        let config = DriveConfig::standard(Joint::Ankle);
        let mut now_ns = if walked { 999 * MS } else { 0 };
        let mut before = walked.then(|| f64::from(drive.status(now_ns).torque_nm));
        // The device's torque follows its command with a first-order lag, as in the plant.
        let (mut given_nm, mut told_at_ns) = (before.unwrap_or(0.0), now_ns);
        for (seq, (step_ns, values, gait_values, chance)) in (1000u32..).zip(ticks) {
            now_ns += step_ns;
            let told_nm = before.unwrap_or(0.0);
            let gives_after = |ns: u64, from_nm: f64| {
                told_nm + (from_nm - told_nm) * (-(ns as f64) / DEVICE_LAG_NS).exp()
            };
            // The sample was made some time between the last tick and this one.
            let age_ns = step_ns * u64::from(chance >> 4) / 15;
            let read_nm = gives_after(step_ns - age_ns, given_nm);
            given_nm = gives_after(step_ns, given_nm);
            if chance < 2 { drive.emergency_stop() } else if chance < 40 { let _ = drive.reset(now_ns); }
            let sample = values.map(|[angle_rad, velocity_rad_s]| JointSample {
                seq, t_ns: now_ns - age_ns, angle_rad, velocity_rad_s, torque_nm: read_nm as f32, ..sample(0)
            });
            let gait = gait_values.map(|(phase, phase_rate_hz, mode, epoch)| GaitState {
                seq, t_ns: now_ns, phase, phase_rate_hz, epoch, ..gait(0, mode)
            });
            let output = drive.tick(now_ns, sample.as_ref(), gait.as_ref());
            walked |= output.state == DriveState::Walk;
            if let Some(torque) = output.command_nm {
                prop_assert!(torque.abs() <= config.law.limit_nm);
                prop_assert!(walked || torque == 0.0);
                let change = (torque - before.unwrap_or(0.0)).abs();
                let since_ns = now_ns - std::mem::replace(&mut told_at_ns, now_ns);
                prop_assert!(change <= config.rate_limit_nm_s * since_ns as f64 * 1e-9 + 1e-5, "{change}");
            }
            before = output.command_nm.or(before);
        }
    }
}

#[test]
fn input_possibly_over_the_age_limit_is_not_used() {
    // given: a drive that walks, and clocks that are known to 6 ms
    let mut drive = walking();
    let gait = |ms| GaitState { t_error_ns: Some(6 * MS), ..gait(ms, GaitMode::Walk) };
    assert_eq!(drive.tick(1000 * MS, Some(&sample(1000)), Some(&gait(1000))).state, DriveState::Walk);
    // then: after 4 ms it may be 10 ms old
    assert_eq!(drive.tick(1004 * MS, Some(&sample(1004)), None).state, DriveState::Walk);
    assert_eq!(drive.tick(1005 * MS, Some(&sample(1005)), None).state, DriveState::Safe);
    // and: with an unknown error, all are rejected
    for t_error_ns in [Some(11 * MS), None] {
        let unknown = GaitState { t_error_ns, ..gait(1006) };
        assert_eq!(drive.tick(1006 * MS, Some(&sample(1006)), Some(&unknown)).state, DriveState::Safe);
    }
    assert_eq!(drive.counters().gait_refused.too_old, 2);
    // and: so is the device's reading after a pause, until it was certainly taken after that
    let mut drive = walking();
    drive.tick(1100 * MS, Some(&sample(1100)), None);
    let perhaps = JointSample { t_error_ns: Some(2 * MS), ..sample(1101) };
    assert_eq!(drive.tick(1101 * MS, Some(&perhaps), None).command_nm, None);
    assert!(
        drive
            .tick(1103 * MS, Some(&JointSample { t_error_ns: Some(2 * MS), ..sample(1103) }), None)
            .command_nm
            .is_some()
    );
}
