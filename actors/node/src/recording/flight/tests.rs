//! The causes and the orders of a flight recorder.

use sinew_model::config::NodeConfig;
use sinew_runtime::tid::Incarnation;

use super::*;

#[test]
fn incident_at_a_held_lock_is_a_cause() {
    let mut config = NodeConfig::new("knee");
    config.project = format!("held {}", std::process::id());
    let state = NodeState::for_test(config, Incarnation(1));
    let flight = Flight::begin(&state, &std::env::temp_dir().join("sinew-held-10.0.0.2.journal"));
    let held = lock(&flight.causes.reported);
    flight.causes.happened(Time::now(), IncidentKind::Symptom, "the knee slips");
    drop(held);
    flight.take_causes(Time::now(), &[]);
    // Of another test's incident at this moment it has the words.
    assert!(!flight.known().is_empty());
}

#[test]
fn spans_are_frozen_before_rings_are_moved() {
    let mut config = NodeConfig::new("knee");
    config.project = format!("orders {}", std::process::id());
    let state = NodeState::for_test(config, Incarnation(1));
    let flight = Flight::begin(&state, &std::env::temp_dir().join("sinew-orders-10.0.0.2.journal"));
    flight.happened(Time::now(), "the knee slips").expect("there is room");
    let mut outputs = std::iter::from_fn(|| lock(&flight.plan).poll(u64::MAX));
    let order = outputs.find_map(|output| match output {
        Output::Freeze(order) => Some(order),
        Output::Forward(_) => None,
    });
    let dead = |id: &str| Order::Move(id.to_owned());
    lock(&flight.work).orders.extend([dead("died-1"), Order::Freeze(order.unwrap()), dead("died-2")]);
    assert!(matches!(flight.next_order(), Some(Order::Freeze(_))));
    assert!(matches!(flight.next_order(), Some(Order::Move(id)) if id == "died-1"));
    flight.is_ending.store(true, Ordering::Relaxed);
    assert!(flight.next_order().is_none(), "the next start moves it");
}

#[test]
fn failure_without_words_counts_after_a_stop_order() {
    let mut config = NodeConfig::new("knee");
    config.project = format!("wordless {}", std::process::id());
    let state = NodeState::for_test(config, Incarnation(1));
    let flight = Flight::begin(&state, &std::env::temp_dir().join("sinew-wordless-10.0.0.2.journal"));
    flight.stop_ordered(Time::now());
    let held = lock(&flight.causes.reported);
    flight.causes.happened(Time::now(), IncidentKind::Failure, "the knee is lost");
    drop(held);
    flight.take_causes(Time::now(), &[]);
    // Failures of other tests of this process are causes, too: they may be first.
    assert!(!flight.known().is_empty());
}
