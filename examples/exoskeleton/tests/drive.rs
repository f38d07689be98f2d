//! The drive: its invariants under every input, and its state machine.

use exoskeleton::control::drive::{DriveConfig, DriveCore, DriveOutput};
use exoskeleton::joint::Joint;
use exoskeleton::message::{DriveState, GaitMode, GaitState, JointSample, Stance};
use proptest::prelude::*;

const MS: u64 = 1_000_000;

fn sample(ms: u64) -> JointSample {
    JointSample {
        seq: ms as u32,
        t_ns: ms * MS,
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
        phase: 0.5,
        phase_rate_hz: 0.75,
        stance: Stance::Stance,
        mode,
        confidence: 1.0,
        epoch: 1,
    }
}

fn drive() -> DriveCore {
    DriveCore::new(DriveConfig::standard(Joint::Ankle))
}

/// Ticks each millisecond of `range` with fresh inputs of `mode`; the last output.
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
fn drive_that_never_heard_its_device_stays_silent() {
    let mut drive = drive();
    assert_eq!(drive.tick(0, None, Some(&gait(0, GaitMode::Walk))).command_nm, None);
}

#[test]
fn gait_state_over_ten_ms_old_makes_the_drive_safe_in_the_same_tick() {
    let mut drive = walking();
    for ms in 1000..1009 {
        assert_eq!(drive.tick(ms * MS, Some(&sample(ms)), None).state, DriveState::Walk, "{ms}");
    }
    assert_eq!(drive.tick(1009 * MS, Some(&sample(1009)), None).state, DriveState::Walk);
    assert_eq!(drive.tick(1009 * MS + 1, Some(&sample(1009)), None).state, DriveState::Safe);
    assert_eq!(drive.counters().safe_entries, 1);
}

#[test]
fn joint_sample_over_ten_ms_old_makes_the_drive_safe_and_its_torque_goes_to_zero() {
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
fn emergency_stop_reaches_zero_in_fifty_ms_and_only_reset_leaves_it() {
    let mut drive = walking();
    drive.emergency_stop();
    let output = feed(&mut drive, 1000..1050, GaitMode::Walk);
    assert_eq!((output.state, output.command_nm), (DriveState::EStop, Some(0.0)));
    assert_eq!(feed(&mut drive, 1050..1500, GaitMode::Walk).state, DriveState::EStop);
    drive.reset();
    assert_eq!(feed(&mut drive, 1500..1510, GaitMode::Hold).state, DriveState::Ready);
}

#[test]
fn insane_inputs_are_refused_counted_and_never_reach_the_torque() {
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
fn sensor_that_restarts_counting_is_believed_once_its_old_words_are_stale() {
    let mut drive = walking();
    for ms in 1000..1020 {
        drive.tick(ms * MS, None, Some(&gait(ms, GaitMode::Safe)));
    }
    let restarted = JointSample { seq: 0, ..sample(1020) };
    let output = drive.tick(1020 * MS, Some(&restarted), Some(&gait(1020, GaitMode::Walk)));
    assert_eq!(output.state, DriveState::Walk);
}

#[test]
fn new_epoch_of_central_is_followed_and_the_old_one_refused() {
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
fn status_tells_the_state_and_starts_a_new_maximum_of_the_age() {
    let mut drive = walking();
    drive.tick(1005 * MS, None, None);
    let status = drive.status(1005 * MS);
    assert_eq!((status.state, status.age_max_us), (DriveState::Walk, 6000));
    feed(&mut drive, 1006..1008, GaitMode::Walk);
    assert_eq!(drive.status(1008 * MS).age_max_us, 0);
}

fn any_mode() -> impl Strategy<Value = GaitMode> {
    prop_oneof![Just(GaitMode::Hold), Just(GaitMode::Sync), Just(GaitMode::Walk), Just(GaitMode::Safe)]
}

/// Step of time (ns), a sample and a gait state that may be garbage, and a die for stop and reset.
type AnyTick = (u64, Option<[f32; 3]>, Option<(f32, f32, GaitMode, u32)>, u8);

/// A tick with anything in it.
fn any_tick() -> impl Strategy<Value = AnyTick> {
    let rough = prop_oneof![4 => -1.0f32..2.0, 1 => any::<f32>()];
    let values = [rough.clone(), rough.clone(), rough.clone()];
    (
        0u64..12 * MS,
        prop::option::weighted(0.8, values),
        prop::option::weighted(0.8, (rough.clone(), rough, any_mode(), 1u32..3)),
        any::<u8>(),
    )
}

proptest! {
    #![proptest_config(ProptestConfig { cases: 96, failure_persistence: None, ..ProptestConfig::default() })]

    #[test]
    fn whatever_comes_in_the_torque_stays_within_limit_and_rate(
        ticks in prop::collection::vec(any_tick(), 1..200)
    ) {
        let mut drive = drive();
        let config = DriveConfig::standard(Joint::Ankle);
        let (mut now_ns, mut walked, mut before) = (0, false, None::<f64>);
        for (seq, (step_ns, values, gait_values, chance)) in (0u32..).zip(ticks) {
            now_ns += step_ns;
            if chance < 4 { drive.emergency_stop() } else if chance < 8 { drive.reset() }
            let sample = values.map(|[angle_rad, velocity_rad_s, torque]| JointSample {
                seq, t_ns: now_ns, angle_rad, velocity_rad_s, torque_nm: torque.clamp(-0.4, 0.4), ..sample(0)
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
                prop_assert!(change <= config.rate_limit_nm_s * step_ns as f64 * 1e-9 + 1e-9, "{change}");
            }
            before = output.command_nm.or(before);
        }
    }
}
