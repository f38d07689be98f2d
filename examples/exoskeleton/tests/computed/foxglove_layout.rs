//! The layout for Foxglove names topics that the recording of a walk has, and fields that their messages have.

use std::collections::BTreeMap;

use exoskeleton::robot::edges::{GAIT, GaitStatus, drive_name, sensor_name};
use exoskeleton_model::joint::Joint;
use exoskeleton_model::message::{DriveTick, FootLoad, JointSample};
use exoskeleton_model::part::Part;
use serde_json::Value;
use sinew::Payload;
use sinew::schema::{Schema, Shape, schema_of};

const LAYOUT: &str = include_str!("../../foxglove-layout.json");
/// The topics of each node that are no messages, of the schema `foxglove.Log`. A walk has no run-time barrier, so none
/// has `/sinew/barriers`.
const EVENTS: [&str; 3] = ["/sinew/events", "/sinew/outcomes", "/sinew/log"];

/// The view of messages from `source` in the file of `node`, after the merge. It holds for messages that `source` sends
/// to one receiver of that node only: otherwise a topic also has its destination.
fn view<P: Payload>(node: Part, source: &str) -> (String, &'static Schema) {
    let schema = schema_of::<P>().expect("the table has room").expect("it is traced").schema();
    (format!("/{node}/{source}/{}/view", P::NAME), schema)
}

fn views() -> BTreeMap<String, &'static Schema> {
    let mut views = vec![
        view::<GaitStatus>(Part::Central, GAIT),
        view::<FootLoad>(Part::Central, &sensor_name(Joint::Ankle)),
    ];
    for joint in Joint::ALL {
        views.push(view::<JointSample>(Part::Central, &sensor_name(joint)));
        views.push(view::<DriveTick>(Part::Joint(joint), &drive_name(joint)));
    }
    views.into_iter().collect()
}

/// Returns the texts under a key, anywhere in a value.
fn texts<'v>(value: &'v Value, key: &str) -> Vec<&'v str> {
    let mut found: Vec<&str> = value.get(key).and_then(Value::as_str).into_iter().collect();
    let inner: Vec<&Value> = match value {
        Value::Array(all) => all.iter().collect(),
        Value::Object(all) => all.values().collect(),
        Value::Null | Value::Bool(_) | Value::Number(_) | Value::String(_) => Vec::new(),
    };
    found.extend(inner.into_iter().flat_map(|inner| texts(inner, key)));
    found
}

/// Splits a message path with a quoted topic: `"/hip/hip.drive/exo.drive_tick/view".torque_nm`.
fn split(path: &str) -> Option<(&str, &str)> {
    path.strip_prefix('"')?.split_once("\".")
}

/// Returns the shape of a value, without the names and options around it.
fn plain<'s>(schema: &'s Schema, shape: &'s Shape) -> &'s Shape {
    let shape = schema.resolve(shape).expect("a traced schema has all its names");
    if let Shape::Option(inner) | Shape::Newtype(inner) = shape { plain(schema, inner) } else { shape }
}

fn has_field(schema: &Schema, path: &str) -> bool {
    let mut shape = plain(schema, &schema.root);
    for name in path.split('.') {
        let Shape::Struct(fields) = shape else { return false };
        let Some(field) = fields.iter().find(|field| field.name == name) else { return false };
        shape = plain(schema, &field.shape);
    }
    // A plot needs a number.
    !matches!(shape, Shape::Struct(_) | Shape::Text | Shape::List(_) | Shape::Unit)
}

#[test]
fn each_plotted_field_is_in_a_recording() {
    let layout: Value = serde_json::from_str(LAYOUT).expect("it is JSON");
    let (paths, views) = (texts(&layout["configById"], "value"), views());
    assert!(paths.len() >= 12, "{paths:?}");
    for path in paths {
        let (topic, field) = split(path).unwrap_or_else(|| panic!("{path}: write \"TOPIC\".FIELD"));
        let schema = views.get(topic).unwrap_or_else(|| panic!("no recording has {topic}"));
        assert!(has_field(schema, field), "{topic} has no number {field}:\n{schema}");
    }
    assert!(!has_field(views["/hip/hip.drive/exo.drive_tick/view"], "torque"), "the check can fail");
}

#[test]
fn each_log_is_in_a_recording() {
    let layout: Value = serde_json::from_str(LAYOUT).expect("it is JSON");
    let topics = texts(&layout["configById"], "topicToRender");
    assert!(!topics.is_empty());
    for topic in topics {
        let is_there = |part: Part| EVENTS.iter().any(|events| topic == format!("/{part}{events}"));
        assert!(Part::ALL.into_iter().any(is_there), "no recording has {topic}");
    }
}

#[test]
fn each_panel_has_its_place() {
    let layout: Value = serde_json::from_str(LAYOUT).expect("it is JSON");
    let mut panels: Vec<&str> =
        layout["configById"].as_object().expect("the panels").keys().map(String::as_str).collect();
    let mut placed = [texts(&layout["layout"], "first"), texts(&layout["layout"], "second")].concat();
    panels.sort_unstable();
    placed.sort_unstable();
    assert_eq!(panels, placed);
}
