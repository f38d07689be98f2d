//! The whole robot in virtual time: limits, faults, and identical bits for the same seed.

use std::sync::Arc;

use exoskeleton::report::{Report, RunDescription, RunMode};
use exoskeleton_model::central::bit;
use exoskeleton_model::gait::trial::Trial;
use exoskeleton_model::intention::{Intention, IntentionError};
use exoskeleton_model::joint::Joint;
use exoskeleton_model::lockstep::{DriveDeath, LockStepConfig, LockStepError, run};
use exoskeleton_model::message::DriveState;
use exoskeleton_model::part::{Kill, Part};
use exoskeleton_model::record::Record;

fn curves(strides: u32, seed: u64) -> LockStepConfig {
    LockStepConfig::standard(strides, seed, Intention::from_curves(seed))
}

fn trial() -> Intention {
    let text = include_str!("../../data/gait_trial_moore2015_s15_pre.csv");
    Intention::from_trial(Arc::new(Trial::parse(text).expect("a valid file")))
}

fn report(config: &LockStepConfig, record: &Record) -> Report {
    let description = RunDescription {
        mode: RunMode::LockStep,
        strides: config.strides,
        seed: config.seed,
        trial: None,
        kill: config.kill.map(|kill| kill.to_string()),
    };
    Report::of(description, record)
}

fn broken(report: &Report) -> Vec<String> {
    report.limits.iter().filter(|l| !l.held).map(|l| format!("{} {:?}", l.name, l.seen)).collect()
}

#[test]
fn built_in_curves_are_walked_within_all_limits() {
    for seed in 1..=5 {
        let config = curves(20, seed);
        let report = report(&config, &run(&config).unwrap());
        assert!(report.passed, "seed {seed}: {:?}", broken(&report));
    }
}

#[test]
fn recorded_trial_is_walked_within_all_limits() {
    let config = LockStepConfig::standard(20, 1, trial());
    let report = report(&config, &run(&config).unwrap());
    assert!(report.passed, "{:?}", broken(&report));
}

#[test]
fn only_the_same_seed_gives_the_same_bits() {
    let bits = |record: &Record| -> Vec<u64> {
        record
            .rows
            .iter()
            .flat_map(|row| {
                let joints = row.joints.iter().flat_map(|joint| {
                    [
                        joint.angle_rad.to_bits(),
                        joint.velocity_rad_s.to_bits(),
                        joint.applied_nm.to_bits(),
                        joint.commanded_nm.map_or(0, f64::to_bits),
                    ]
                });
                let phases = [row.strides_true.to_bits(), row.phase_estimated.to_bits()];
                joints.chain(phases).collect::<Vec<_>>()
            })
            .collect()
    };
    let (first, again) = (run(&curves(8, 3)).unwrap(), run(&curves(8, 3)).unwrap());
    assert_eq!(bits(&first), bits(&again));
    assert_ne!(bits(&first), bits(&run(&curves(8, 4)).unwrap()));
}

#[test]
fn torque_is_zero_until_the_late_node_arrives() {
    let config = curves(8, 1);
    let record = run(&config).unwrap();
    let late_s = config.start_ms[Joint::Hip.index()] as f64 * 1e-3;
    assert!(record.ready_s.iter().all(|ready_s| ready_s.unwrap() > late_s));
    let released_s = record.released_s.unwrap();
    for row in record.rows.iter().take_while(|row| row.t_s <= released_s) {
        for joint in &row.joints {
            assert_eq!(joint.applied_nm, 0.0);
            assert!(joint.commanded_nm.is_none_or(|torque| torque == 0.0));
        }
    }
}

#[test]
fn walk_resumes_after_the_loss_of_any_node() {
    for part in Part::ALL {
        let config = LockStepConfig { kill: Some(Kill { part, stride: 8 }), ..curves(20, 1) };
        let record = run(&config).unwrap();
        let report = report(&config, &record);
        assert!(report.passed, "{part}: {:?}", broken(&report));
        let fault = report.figures.fault.unwrap();
        // Ten milliseconds of age, one of transport, one of the tick.
        assert!(fault.all_safe_after_ms.unwrap() <= 12.0, "{part}: {fault:?}");
    }
}

#[test]
fn dead_drives_device_holds_torque_until_its_watchdog_acts() {
    let kill = Some(Kill { part: Part::Joint(Joint::Ankle), stride: 8 });
    let ankle = Joint::Ankle.index();
    let held = |watchdog_ns| {
        let mut config = LockStepConfig { kill, ..curves(9, 1) };
        config.plant.watchdog_ns = watchdog_ns;
        let record = run(&config).unwrap();
        let dead: Vec<f64> = record
            .rows
            .iter()
            .filter(|row| row.joints[ankle].state.is_none() && row.t_s > record.released_s.unwrap())
            .map(|row| row.joints[ankle].applied_nm)
            .collect();
        // After the device's lag has passed.
        dead[200..900].iter().all(|torque| (torque - dead[200]).abs() < 1e-9)
    };
    assert!(held(None));
    assert!(!held(Some(10_000_000)));
}

#[test]
fn returning_drive_does_not_step_its_torque() {
    let kill = Some(Kill { part: Part::Joint(Joint::Ankle), stride: 8 });
    let record = run(&LockStepConfig { kill, ..curves(12, 1) }).unwrap();
    for pair in record.rows.windows(2) {
        for (before, after) in pair[0].joints.iter().zip(&pair[1].joints) {
            assert!((after.applied_nm - before.applied_nm).abs() <= 2.0 + 1e-9, "at {} s", pair[1].t_s);
        }
    }
}

#[test]
fn drives_never_walk_without_central() {
    let kill = Some(Kill { part: Part::Central, stride: 8 });
    let record = run(&LockStepConfig { kill, ..curves(12, 1) }).unwrap();
    let outage = record.outage.unwrap();
    let away = |t_s: f64| t_s > outage.from_s + 0.012 && t_s < outage.to_s.unwrap();
    for row in record.rows.iter().filter(|row| away(row.t_s)) {
        assert!(row.joints.iter().all(|joint| joint.state == Some(DriveState::Safe)), "at {} s", row.t_s);
    }
}

#[test]
fn too_short_trial_is_rejected_with_a_remedy() {
    let error = run(&LockStepConfig::standard(500, 1, trial())).unwrap_err();
    assert!(matches!(error, LockStepError::Intention(IntentionError::TrialTooShort { wanted: 500, .. })));
    assert!(error.to_string().contains("--strides"));
}

#[test]
fn report_of_virtual_time_has_no_real_time_figures() {
    let config = curves(8, 1);
    let json = serde_json::to_value(report(&config, &run(&config).unwrap())).unwrap();
    for pointer in [
        "/strides",
        "/rms_deg/hip",
        "/rms_deg/knee",
        "/rms_deg/ankle",
        "/phase_rms_percent",
        "/work_positive_j_per_stride/hip",
        "/work_positive_j_per_stride/knee",
        "/work_positive_j_per_stride/ankle",
        "/barrier/held_s",
        "/barrier/ready_skew_ms",
        "/barrier/torque_before_release_nm",
        "/limits/0/expected",
    ] {
        assert!(json.pointer(pointer).is_some_and(|value| !value.is_null()), "{pointer}");
    }
    for unmeasured in ["/period_us", "/age_us", "/deadline_misses"] {
        assert!(json.pointer(unmeasured).is_some_and(serde_json::Value::is_null), "{unmeasured}");
    }
    assert!(json["passed"].is_boolean() && json["timing_measured"] == false);
}

/// The drive of `joint` dies at `phase` of the ninth stride and is back 400 ms later.
fn drive_dies(joint: Joint, phase: f64, watchdog_ms: Option<u64>) -> Record {
    let death = DriveDeath { joint, at_strides: 8.0 + phase, outage_ms: 400 };
    let mut config = LockStepConfig { drive_death: Some(death), ..curves(11, 1) };
    config.plant.watchdog_ns = watchdog_ms.map(|ms| ms * 1_000_000);
    run(&config).expect("a run that ends")
}

/// Maximum deviation of a joint from the person's intention, in the stride after the death, degrees.
fn deviation_deg(record: &Record, joint: Joint, phase: f64) -> f64 {
    let deviation = |row: &exoskeleton_model::record::Row| {
        let joint = &row.joints[joint.index()];
        (joint.angle_rad - joint.intended_rad).abs().to_degrees()
    };
    let window = 8.0 + phase..9.0 + phase;
    record.rows.iter().filter(|row| window.contains(&row.strides_true)).map(deviation).fold(0.0, f64::max)
}

#[test]
fn dead_knee_drive_is_flagged_while_others_walk() {
    for phase in [0.12, 0.40, 0.62, 0.75] {
        let record = drive_dies(Joint::Knee, phase, Some(8));
        let after = |row: &&exoskeleton_model::record::Row| row.strides_true > 8.0 + phase;
        for joint in [Joint::Hip, Joint::Ankle] {
            let walks = |row: &exoskeleton_model::record::Row| {
                row.joints[joint.index()].state == Some(DriveState::Walk)
            };
            assert!(record.rows.iter().filter(after).all(walks), "{joint} at {phase}");
        }
        let flagged: Vec<u8> = record.rows.iter().filter(after).map(|row| row.degraded).collect();
        assert!(flagged.contains(&bit(Joint::Knee)), "{phase}");
        assert!(flagged.iter().all(|bits| bits & !bit(Joint::Knee) == 0), "{phase}");
        assert_eq!(flagged.last(), Some(&0), "{phase}");
        assert!(deviation_deg(&record, Joint::Knee, phase) <= 10.0, "{phase}");
    }
}

#[test]
fn device_watchdog_prevents_a_stuck_ankle_torque() {
    let phase = 0.60;
    let protected = deviation_deg(&drive_dies(Joint::Ankle, phase, Some(8)), Joint::Ankle, phase);
    let unprotected = deviation_deg(&drive_dies(Joint::Ankle, phase, None), Joint::Ankle, phase);
    assert!(protected <= 12.0, "{protected} deg");
    assert!(unprotected > 12.0 && unprotected > 2.0 * protected, "{unprotected} deg");
}
