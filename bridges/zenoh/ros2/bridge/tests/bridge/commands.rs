//! Topics with commands, and messages that are refused.

use std::{thread, time::Duration};

use sinew_ros2_core::Value;
use sinew_testkit::until;

use crate::stage::{Done, Stage};

#[test]
fn only_commands_of_a_rule_reach_the_drive() {
    let mut stage = Stage::start();
    // The rule halves the number. Until the nodes have reported their guards none passes.
    until("a torque of 1.5", || {
        stage.peer.publish_number("/knee/torque", 3.0);
        thread::sleep(Duration::from_millis(20));
        stage.log.all().contains(&Done::Torque(15)).then_some(())
    });
    let array = Value::Message(vec![
        Value::Message(vec![Value::List(Vec::new()), Value::Unsigned(0)]),
        Value::List(vec![Value::Float(9.0)]),
    ]);
    stage.peer.publish("/knee/torque", "std_msgs/msg/Float64MultiArray", &array);
    stage.bridge.wait_for(&["refused", "of /knee/torque", "other type"]);
    stage.peer.publish_number("/knee/torque", f64::NAN);
    stage.bridge.wait_for(&["refused", "of /knee/torque", "malformed", "not finite"]);
    stage.peer.publish_number("/exo/knee/torque", 9.0);
    stage.bridge.wait_for(&["refused", "of /exo/knee/torque", "no rule"]);
    stage.peer.publish_number("/knee/bare_push", 9.0);
    stage.bridge.wait_for(&["refused", "of /knee/bare_push", "unprotected", "demo.push is guarded"]);
    // Messages are in order: all of these were handled before.
    stage.peer.publish_number("/knee/torque", 4.0);
    stage.log.wait_for(Done::Torque(20));
    let all = stage.log.all();
    assert!(all.iter().all(|done| matches!(done, Done::Torque(15 | 20) | Done::Safe)), "{all:?}");
}

#[test]
fn guarded_command_needs_a_protected_sender() {
    let stage = Stage::start();
    until("a push of 2.5 N through the guard", || {
        stage.peer.publish_number("/knee/push", 2.5);
        thread::sleep(Duration::from_millis(20));
        stage.log.all().contains(&Done::Push(25)).then_some(())
    });
}

#[test]
fn refusals_are_counted_on_diagnostics() {
    let stage = Stage::start();
    let of = "diagnostic_msgs/msg/DiagnosticArray";
    let (_subscriber, taken) = stage.peer.subscribe("/diagnostics", of);
    stage.peer.publish_number("/exo/unknown", 1.0);
    until("the count of a refusal", || {
        let (array, _) = taken.recv_timeout(Duration::from_secs(5)).ok()?;
        let statuses = array.at(1)?.list().to_vec();
        let status = statuses
            .iter()
            .find(|status| status.at(1).is_some_and(|name| name.text().ends_with("/exo/unknown")))?;
        let pair = |key: &str, value: &str| {
            Value::Message(vec![Value::Text(key.to_owned()), Value::Text(value.to_owned())])
        };
        assert_eq!(status.at(4).map(Value::list), Some(&[pair("passed", "0"), pair("no rule", "1")][..]));
        Some(())
    });
}
