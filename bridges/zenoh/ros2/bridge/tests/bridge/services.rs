//! Parameters and the stop as services.

use sinew_ros2_core::Value;

use crate::stage::{Done, Stage};

fn text(text: &str) -> Value {
    Value::Text(text.to_owned())
}

fn texts(all: &[&str]) -> Value {
    Value::List(all.iter().map(|one| text(one)).collect())
}

/// A `ParameterValue` with this number.
fn number(number: f64) -> Value {
    let mut members =
        vec![Value::Unsigned(3), Value::Bool(false), Value::Signed(0), Value::Float(number), text("")];
    members.extend((0..5).map(|_| Value::List(Vec::new())));
    Value::Message(members)
}

/// A request that sets parameters to numbers.
fn set(all: &[(&str, f64)]) -> Value {
    let one = |(name, value): &(&str, f64)| Value::Message(vec![text(name), number(*value)]);
    Value::Message(vec![Value::List(all.iter().map(one).collect())])
}

#[test]
fn parameters_are_listed_set_and_refused() {
    let stage = Stage::start();
    let service =
        |name: &str| stage.peer.catalog.service(&format!("rcl_interfaces/srv/{name}")).expect("a service");
    let call = |topic: &str, name: &str, request: &Value| {
        stage.peer.call(&format!("/knee_drive/{topic}"), &service(name), request)
    };
    let all = Value::Message(vec![Value::List(Vec::new()), Value::Unsigned(0)]);
    let listed = call("list_parameters", "ListParameters", &all).expect("a response");
    let names = listed.at(0).and_then(|result| result.at(0)).cloned();
    assert_eq!(names, Some(texts(&["assistance", "steps", "damped"])));

    let names = Value::Message(vec![texts(&["assistance", "damped", "nothing"])]);
    let types = call("get_parameter_types", "GetParameterTypes", &names).expect("a response");
    assert_eq!(types.at(0), Some(&Value::List([3, 1, 0].map(Value::Unsigned).to_vec())));
    let described = call("describe_parameters", "DescribeParameters", &names).expect("a response");
    let read_only: Vec<_> =
        described.at(0).expect("descriptors").list().iter().map(|one| one.at(4).cloned()).collect();
    assert_eq!(read_only, [false, true, true].map(|truth| Some(Value::Bool(truth))));

    let result = |successful: bool, done: &Value| {
        assert_eq!(done.at(0), Some(&Value::Bool(successful)), "{done:?}");
        done.at(1).expect("a reason").text().to_owned()
    };
    let done = call(
        "set_parameters",
        "SetParameters",
        &set(&[("assistance", 0.5), ("assistance", 1.5), ("damped", 1.0)]),
    );
    let done = done.expect("a response").at(0).expect("results").list().to_vec();
    assert_eq!(result(true, &done[0]), "");
    assert!(result(false, &done[1]).contains("outside 0.0 to 1.0"));
    assert!(result(false, &done[2]).contains("read-only for ROS 2"));
    let both = set(&[("assistance", 0.75), ("steps", 2.5)]);
    let done = call("set_parameters_atomically", "SetParametersAtomically", &both).expect("a response");
    assert!(result(false, done.at(0).expect("a result")).contains("steps"));
    let one = Value::Message(vec![texts(&["assistance"])]);
    let got = call("get_parameters", "GetParameters", &one).expect("a response");
    assert_eq!(got.at(0), Some(&Value::List(vec![number(0.5)])));

    let malformed =
        stage.peer.call_with("/knee_drive/get_parameters", &service("GetParameters"), vec![0, 1, 0, 0, 255]);
    assert!(malformed.expect_err("no request").contains("malformed"));
}

#[test]
fn stop_is_pressed_by_a_service() {
    let stage = Stage::start();
    let trigger = stage.peer.catalog.service("std_srvs/srv/Trigger").expect("a service");
    let request = Value::zero(&trigger.request);
    let response = stage.peer.call("/exo/stop", &trigger, &request).expect("a response");
    println!("{response:?}");
    assert!(
        response.at(1).expect("a text").text().contains("stopped: 1 nodes have confirmed"),
        "{response:?}"
    );
    assert_eq!(response.at(0), Some(&Value::Bool(true)));
    stage.log.wait_for(Done::Safe);
}
