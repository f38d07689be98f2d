//! Topics that are published, and the graph that ROS 2 shows.

use std::{
    collections::BTreeSet,
    time::{Duration, Instant},
};

use sinew_ros2_core::{EndpointKind, Value, parse_token};
use sinew_testkit::{DEADLINE, until};
use zenoh::Wait as _;

use crate::stage::Stage;

#[test]
fn sensor_becomes_joint_states_at_the_stated_rate() {
    let stage = Stage::start();
    let (_subscriber, taken) = stage.peer.subscribe("/joint_states", "sensor_msgs/msg/JointState");
    let (first, earlier) = taken.recv_timeout(DEADLINE).expect("a message");
    let text = |text: &str| Value::Text(text.to_owned());
    assert_eq!(first.at(0).and_then(|header| header.at(1)), Some(&text("leg")));
    assert_eq!(first.at(1), Some(&Value::List(vec![text("knee")])));
    assert_eq!(first.at(2), Some(&Value::List(vec![Value::Float(3.0)])));
    let began = Instant::now();
    let mut count = 0_u32;
    let mut last = earlier;
    while began.elapsed() < Duration::from_secs(1) {
        let (_, attachment) = taken.recv_timeout(DEADLINE).expect("a message");
        assert!(attachment.sequence > last.sequence && attachment.gid == last.gid);
        (last, count) = (attachment, count + 1);
    }
    // One may come early, and those that waited for this thread come at once.
    let sent = u32::try_from(last.sequence - earlier.sequence).expect("a number");
    let spent = Duration::from_nanos((last.time_ns - earlier.time_ns).unsigned_abs());
    println!("{count} messages, {sent} numbers in {spent:?}");
    assert!(f64::from(sent) <= spent.as_secs_f64() * 100.0 + 3.0);
}

#[test]
fn graph_shows_nodes_topics_and_services() {
    let stage = Stage::start();
    let seen = until("the tokens of the bridge", || {
        let replies = stage.peer.session.liveliness().get("@ros2_lv/7/**").timeout(DEADLINE).wait();
        let mut seen = BTreeSet::new();
        for reply in replies.expect("a question") {
            let Ok(sample) = reply.result() else { continue };
            let token = parse_token(sample.key_expr().as_str()).expect("a token");
            let of = token.endpoint.map_or_else(
                || "node".to_owned(),
                |endpoint| format!("{:?} {} {}", endpoint.kind, endpoint.topic, endpoint.dds_type),
            );
            seen.insert(format!("{}: {of}", token.node));
        }
        (seen.len() >= 14).then_some(seen)
    });
    let kind = EndpointKind::Publisher;
    for line in [
        "/sinew: node".to_owned(),
        "/knee_drive: node".to_owned(),
        format!("/sinew: {kind:?} /joint_states sensor_msgs::msg::dds_::JointState_"),
        format!("/sinew: {kind:?} /diagnostics diagnostic_msgs::msg::dds_::DiagnosticArray_"),
        "/sinew: Subscription /knee/torque std_msgs::msg::dds_::Float64_".to_owned(),
        "/sinew: Service /exo/stop std_srvs::srv::dds_::Trigger_".to_owned(),
        "/knee_drive: Service /knee_drive/set_parameters rcl_interfaces::srv::dds_::SetParameters_"
            .to_owned(),
    ] {
        assert!(seen.contains(&line), "{line}: {seen:#?}");
    }
    assert!(!seen.iter().any(|line| line.contains("/exo/") && !line.contains("/exo/stop")), "{seen:#?}");
}
