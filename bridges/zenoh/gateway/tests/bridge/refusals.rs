//! Messages that do not pass: foreign keys, messages without a rule, malformed payloads.

use zenoh::Wait;

use crate::stage::{RULES, Stage, get};

#[test]
fn foreign_keys_and_malformed_payloads_are_refused_and_counted() {
    let Some(mut stage) = Stage::start(RULES, "") else { return };
    stage.bridge.wait_for(&["the structure of robot.move"]);
    let session = stage.session();
    let put =
        |key: &str, payload: &str| session.put(key.to_owned(), payload.to_owned()).wait().expect("a session");
    let moves = stage.key("n/knee.drive/robot.move");

    put(&stage.key("n/knee.drive"), "{}");
    put(&stage.key("n/*/robot.move"), "{}");
    stage.wait_for_count("foreign_key", 2);
    put(&stage.key("n/motor/robot.torque"), "{}");
    stage.wait_for_count("no_rule", 1);
    put(&stage.key("n/knee.drive/robot.get_angle"), "{}");
    session.delete(&moves).wait().expect("a session");
    stage.wait_for_count("not_this_act", 2);

    put(&moves, "{degrees}");
    put(&moves, r#"{"degrees":"much"}"#);
    put(&moves, r#"{"degree":1}"#);
    put(&moves, r#"{"degrees":1e300}"#);
    stage.wait_for_count("malformed", 4);
    let why = get(&session, &moves, r#"{"degrees":null}"#).expect_err("it does not fit");
    assert!(why.contains("field `degrees`: expected f32, found nothing"), "{why}");
    let why = get(&session, &stage.key("n/*/robot.move"), "{}").expect_err("it has a wildcard");
    assert!(why.contains("its key names no destination"), "{why}");

    // A message that a bridge has sent does not come round.
    let put_by_bridge = session.put(&moves, r#"{"degrees":5}"#).attachment(r#"{"bridge":"9f"}"#);
    put_by_bridge.wait().expect("a session");
    stage.wait_for_count("from_bridge", 1);
    put(&moves, r#"{"degrees":6}"#);
    stage.robot.wait_for(&["moved to 6"]);
    assert!(!stage.robot.output().iter().any(|line| line == "moved to 5"), "{:?}", stage.robot.output());
    stage.wait_for_count("put_in", 1);
}
