//! Barriers at which programs in C and in Rust meet.

use std::time::Duration;

use sinew::{Registration, barrier::Barrier};

use super::ground::{C, Ground, WATCHDOG, endpoint, is_there};

#[test]
fn c_axes_start_and_step_with_a_rust_axis() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    let axis = C.shared("examples/axis.c", &ground);
    let start = |name| ground.start(&axis, &[name]);
    let mut in_c = [start("knee.axis"), start("ankle.axis")];
    let axes = ["hip.axis", "knee.axis", "ankle.axis"];
    let mut hip = endpoint(&ground, Registration::new().name("hip.axis"));
    assert_eq!(hip.meet(&Barrier::phase("homed", axes).within(WATCHDOG)).unwrap(), 1);
    in_c.iter_mut().for_each(|axis| drop(axis.wait_for(&["all axes are homed"])));
    for round in 1..=3 {
        assert_eq!(hip.meet(&Barrier::new("step", axes).within(WATCHDOG)).unwrap(), round);
        in_c.iter_mut().for_each(|axis| drop(axis.wait_for(&[&format!("step {round}")])));
    }
    in_c.iter_mut().for_each(|axis| assert_eq!(axis.wait_for_exit(), Some(0)));
}

#[test]
fn unopened_barrier_reports_the_same_in_c_and_rust() {
    if !is_there("gcc") {
        return;
    }
    let ground = Ground::new();
    let mut hip = endpoint(&ground, Registration::new().name("hip"));
    let within = Duration::from_millis(20);
    let mut error_of = |barrier: Barrier| hip.meet(&barrier.within(within)).unwrap_err().to_string();
    let late = error_of(Barrier::new("ready", ["hip", "knee"]));
    let late_phase = error_of(Barrier::phase("ready", ["hip", "knee"]));
    let no_party = error_of(Barrier::new("ready", ["knee", "ankle"]));
    assert!(late.contains("knee is missing (not there)"), "{late}");
    hip.unregister().unwrap();
    let mut program = ground.start(&C.shared("tests/programs/barriers.c", &ground), &[]);
    for line in [
        format!("late -21 {late}"),
        format!("late phase -21 {late_phase}"),
        format!("no party -3 {no_party}"),
        "alone 0 done".to_owned(),
        "again 0 done".to_owned(),
        "generation 2".to_owned(),
        "no barrier -1 `barrier` is NULL".to_owned(),
        "no endpoint -13".to_owned(),
        "odd flags -1 `barrier.flags` is 0x40".to_owned(),
        "reserved -1 `barrier.reserved` is 7".to_owned(),
        "no texts -1 `barrier.parties` is NULL".to_owned(),
    ] {
        program.wait_for(&[&line]);
    }
    assert_eq!(program.wait_for_exit(), Some(0));
}
