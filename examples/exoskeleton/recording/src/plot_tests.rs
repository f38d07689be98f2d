//! Tests of the picture.

use exoskeleton_model::intention::Intention;
use exoskeleton_model::lockstep::{LockStepConfig, run};

use super::*;

#[test]
fn phase_error_is_not_drawn_without_an_estimate() {
    let drawn = broken(vec![(6.99, 1.0), (7.0, 1.2), (9.0, 0.1), (9.01, 0.1)], 20.0, STRIDES_UNKNOWN_MIN);
    assert_eq!(drawn.len(), 5);
    assert!(drawn[2].1.is_nan());
}

#[test]
fn lateness_has_a_panel_only_when_it_was_measured() {
    let record = run(&LockStepConfig::standard(8, 1, Intention::from_curves(1))).unwrap();
    let lateness = Lateness { bucket_us: 10.0, counts: vec![20_000, 900, 30, 0, 1] };
    let text = |lateness| figure(&Figure { record: &record, title: "t", caption: "c", lateness });
    assert!(text(Some(&lateness)).contains("Loop lateness"));
    assert!(!text(None).contains("Loop lateness"));
    assert!(!text(None).contains("NaN"));
}
