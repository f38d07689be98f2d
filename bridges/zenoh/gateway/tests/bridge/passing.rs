//! Messages, requests and outcomes that rules let pass.

use serde_json::{Value, json};
use zenoh::Wait;

use crate::stage::{RULES, Stage, get, next, subscribe};

fn parsed(text: &[u8]) -> Value {
    serde_json::from_slice(text).expect("JSON")
}

#[test]
fn messages_of_a_group_are_put_as_json() {
    let Some(stage) = Stage::start(RULES, "") else { return };
    let session = stage.session();
    let samples = subscribe(&session, &stage.key("g/telemetry/robot.angle"));
    let sample = next(&samples);
    assert_eq!(parsed(&sample.payload().to_bytes()), json!({ "joint": "knee", "degrees": 10.0 }));
    assert_eq!(sample.encoding().to_string(), "application/json");
    assert_eq!(sample.priority(), zenoh::qos::Priority::InteractiveHigh);
    let attachment = parsed(&sample.attachment().expect("it has one").to_bytes());
    assert_eq!(attachment["class"], json!("stream"));
    assert!(attachment["source"].as_str().is_some_and(|source| source.starts_with("127.0.0.1/")));
    assert!(attachment["age_us"].is_u64(), "{attachment}");
}

#[test]
fn put_is_a_message_and_get_has_an_outcome() {
    let Some(mut stage) = Stage::start(RULES, "") else { return };
    let session = stage.session();
    let moves = stage.key("n/knee.drive/robot.move");
    session.put(&moves, r#"{"degrees":30}"#).wait().expect("a session");
    stage.robot.wait_for(&["moved to 30"]);

    assert_eq!(
        get(&session, &moves, r#"{"degrees":40}"#).map(|text| parsed(text.as_bytes())),
        Ok(json!({ "outcome": "Delivered" }))
    );
    let rejected = parsed(get(&session, &moves, r#"{"degrees":300}"#).expect("an outcome").as_bytes());
    assert_eq!((&rejected["outcome"], &rejected["reason"]), (&json!("Rejected"), &json!("ByHandler")));

    let angle = get(&session, &stage.key("n/knee.drive/robot.get_angle"), "").expect("a reply");
    assert_eq!(parsed(angle.as_bytes()), json!({ "joint": "knee", "degrees": 40.0 }));
    stage.wait_for_count("confirmed_in", 2);
    stage.wait_for_count("asked_in", 1);
    stage.wait_for_count("put_in", 1);
}
