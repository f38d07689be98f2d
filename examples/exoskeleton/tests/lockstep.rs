//! The whole robot in virtual time.
use exoskeleton::gait::trial::Trial;
use exoskeleton::intention::Intention;
use exoskeleton::lockstep::{LockStepConfig, run};
use exoskeleton::metrics::Metrics;
use std::sync::Arc;

#[test]
#[ignore]
fn figures() {
    let trial = Arc::new(Trial::parse(include_str!("../data/gait_trial_moore2015_s15_pre.csv")).unwrap());
    for seed in 0..=5 {
        let intention =
            if seed == 0 { Intention::from_trial(trial.clone()) } else { Intention::from_curves(seed) };
        let record = run(&LockStepConfig::standard(20, seed, intention)).unwrap();
        let m = Metrics::of(&record);
        println!(
            "{seed} rms {:.2?} int {:.2?} phase {:.2} max {:.1} W+ {:.2?} sum {:.2} W- {:.2?} sat {:.2?} peak {:.1?} from {:?}",
            m.rms_deg,
            m.rms_intended_deg,
            m.phase_rms_percent,
            m.phase_max_percent,
            m.work_positive_j_per_stride,
            m.work_positive_j_per_stride.iter().sum::<f64>(),
            m.work_negative_j_per_stride,
            m.saturation_percent,
            m.torque_peak_nm,
            m.assisted_from_stride
        );
    }
}
