//! The Rust plant and drives against the Python reference model on the same trial: each joint's trajectory
//! differs by at most 0.1 degrees RMS. `model/reference.py` creates the golden files.

use std::sync::Arc;

use exoskeleton_model::control::drive::{DriveConfig, DriveCore};
use exoskeleton_model::gait::table::Table;
use exoskeleton_model::gait::trial::Trial;
use exoskeleton_model::intention::Intention;
use exoskeleton_model::joint::{Joint, PerJoint};
use exoskeleton_model::message::{GaitMode, GaitState, Stance};
use exoskeleton_model::phase::oscillator::{Oscillator, OscillatorGains};
use exoskeleton_model::phase::wrapped;
use exoskeleton_model::plant::{PlantConfig, PlantCore};
use exoskeleton_model::sensor::{SensorConfig, SensorCore};

const MS: u64 = 1_000_000;
const STEPS: usize = 27_000;
const DECIMATED: usize = 50;
/// Index of the heel strike at which both models begin.
const FIRST_STRIKE: usize = 2;
/// Head start of the oscillator, ms.
const WARM_UP: usize = 3_000;
const RMS_MAX_DEG: f64 = 0.1;

/// Phase and phase rate (cycles, cycles per second) for the drives in each step.
type Phases = Vec<(f64, f64)>;

#[test]
fn true_phase_matches_the_reference_model() {
    let trial = trial();
    let start_s = trial.heel_strikes_s()[FIRST_STRIKE];
    let phases = (0..STEPS).map(|i| trial.strides_at(start_s + i as f64 * 1e-3)).collect();
    compare("true phase", &trial, &phases, include_str!("golden/true_phase.csv"));
}

#[test]
fn oscillator_phase_matches_the_reference_model() {
    let trial = trial();
    let start_s = trial.heel_strikes_s()[FIRST_STRIKE] - 1e-3 * WARM_UP as f64;
    let mut oscillator = Oscillator::new(OscillatorGains::default());
    let phases: Phases = (0..WARM_UP + STEPS)
        .map(|i| {
            let time_s = start_s + i as f64 * 1e-3;
            let found = oscillator.tick(trial.hip_raw_deg(time_s), trial.vertical_load_bw(time_s), 1e-3);
            (found.phase, found.rate_hz)
        })
        .skip(WARM_UP)
        .collect();
    compare("estimated phase", &trial, &phases, include_str!("golden/estimated_phase.csv"));
}

fn trial() -> Arc<Trial> {
    Arc::new(
        Trial::parse(include_str!("../../../data/gait_trial_moore2015_s15_pre.csv")).expect("a valid file"),
    )
}

fn compare(name: &str, trial: &Arc<Trial>, phases: &Phases, golden: &str) {
    let columns = ["phase", "hip_deg", "knee_deg", "ankle_deg", "hip_nm", "knee_nm", "ankle_nm"];
    let golden = Table::parse(golden, &columns).expect("a valid file");
    let walked = walk(trial, phases);
    assert_eq!(golden.rows().len(), walked.len() / DECIMATED);
    let mut sums = [0.0; 6];
    for (row, i) in golden.rows().iter().zip((0..).step_by(DECIMATED)) {
        let phase_difference = wrapped(row.values[0] - phases[i].0).abs();
        assert!(phase_difference < 1e-3, "{name}: phase differs by {phase_difference} at step {i}");
        for (k, sum) in sums.iter_mut().enumerate() {
            *sum += (row.values[1 + k] - walked[i][k]).powi(2);
        }
    }
    let rms = sums.map(|sum| (sum / golden.rows().len() as f64).sqrt());
    println!("{name}: RMS difference hip/knee/ankle {:.4?} deg, torque {:.4?} Nm", &rms[..3], &rms[3..]);
    for joint in Joint::ALL {
        let difference = rms[joint.index()];
        assert!(difference <= RMS_MAX_DEG, "{name}: {joint} differs by {difference} deg RMS");
    }
}

/// Angles (deg) after each step and torques (Nm) applied in it: ideal devices, no noise, no ramp, 1 ms from
/// command to torque, as in the reference model.
fn walk(trial: &Arc<Trial>, phases: &Phases) -> Vec<[f64; 6]> {
    let intention = Intention::from_trial(Arc::clone(trial)).without_onset();
    let mut plant = PlantCore::new(PlantConfig::as_reference(), intention, 0);
    plant.start_walking();
    plant.place_on_intention();
    let mut robot = Robot::new();
    // One tick to become ready, then walking.
    robot.tick(&mut plant, 1, phases[0]);
    phases
        .iter()
        .enumerate()
        .map(|(i, phase)| {
            let before = robot.commands_nm;
            robot.tick(&mut plant, i as u64 + 2, *phase);
            plant.step(MS, &before);
            let truth = plant.truth();
            let [hip, knee, ankle] = truth.leg.angle_rad.map(f64::to_degrees);
            [hip, knee, ankle, truth.applied_nm[0], truth.applied_nm[1], truth.applied_nm[2]]
        })
        .collect()
}

struct Robot {
    sensors: PerJoint<SensorCore>,
    drives: PerJoint<DriveCore>,
    commands_nm: PerJoint<Option<f64>>,
}

impl Robot {
    fn new() -> Self {
        let sensor = SensorConfig { encoder_step_rad: 0.0 };
        Self {
            sensors: Joint::ALL.map(|_| SensorCore::new(sensor)),
            drives: Joint::ALL.map(|joint| {
                let standard = DriveConfig::standard(joint);
                DriveCore::new(DriveConfig { reentry_s: 0.0, rejoin_s: 0.0, device_lag_s: 0.0, ..standard })
            }),
            commands_nm: [None; 3],
        }
    }

    fn tick(&mut self, plant: &mut PlantCore, ms: u64, (strides, rate_hz): (f64, f64)) {
        let now_ns = ms * MS;
        let gait = GaitState {
            seq: u32::try_from(ms).expect("27 seconds fit"),
            t_ns: now_ns,
            t_error_ns: Some(0),
            phase: strides.rem_euclid(1.0) as f32,
            phase_rate_hz: rate_hz as f32,
            stance: Stance::Stance,
            mode: GaitMode::Walk,
            confidence: 1.0,
            epoch: 1,
            degraded: 0,
        };
        let readings = plant.read();
        for i in 0..3 {
            let sample = self.sensors[i].sample(now_ns, &readings.joints[i]);
            self.commands_nm[i] = self.drives[i].tick(now_ns, Some(&sample), Some(&gait)).command_nm;
        }
    }
}
