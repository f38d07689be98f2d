//! Liveliness tokens of applications and nodes, and names that a Zenoh program has.

use std::sync::mpsc::{Receiver, sync_channel};

use sinew_testkit::DEADLINE;
use zenoh::{Session, Wait, query::Query, sample::SampleKind};

use crate::stage::{Stage, robot};

const RULES: &str = r#"
[liveness]
apps = ["knee.*"]
nodes = true

[[out]]
name = "operator"
types = ["robot.question"]
encoding = "json"
reply = "robot.answer"
within_ms = 5000
"#;

fn tokens(session: &Session, key: &str) -> Receiver<(String, SampleKind)> {
    let (put, changes) = sync_channel(100);
    let callback = move |sample: zenoh::sample::Sample| {
        let _ = put.try_send((sample.key_expr().to_string(), sample.kind()));
    };
    let subscriber = session.liveliness().declare_subscriber(key.to_owned()).history(true);
    subscriber.callback(callback).background().wait().expect("a key");
    changes
}

#[track_caller]
fn wait_for(changes: &Receiver<(String, SampleKind)>, key: &str, kind: SampleKind) {
    let mut seen = Vec::new();
    loop {
        let change = changes.recv_timeout(DEADLINE);
        let change = change.unwrap_or_else(|why| panic!("no {kind:?} of {key}: {why}; {seen:?}"));
        if change.0.ends_with(key) && change.1 == kind {
            return;
        }
        seen.push(change);
    }
}

#[test]
fn tokens_follow_applications_and_nodes() {
    let Some(mut stage) = Stage::start(RULES, "") else { return };
    let session = stage.session();
    let changes = tokens(&session, &stage.key("@/**"));
    wait_for(&changes, "/knee.drive", SampleKind::Put);
    let nodes = tokens(&session, &stage.key("@/*"));
    wait_for(&nodes, "@/7f000001", SampleKind::Put);

    assert!(stage.robot.kill());
    wait_for(&changes, "/knee.drive", SampleKind::Delete);
    wait_for(&nodes, "@/7f000001", SampleKind::Delete);

    stage.robot = robot(&stage.directory, &stage.project, "");
    wait_for(&changes, "/knee.drive", SampleKind::Put);
    wait_for(&nodes, "@/7f000001", SampleKind::Put);
}

#[test]
fn program_with_a_token_is_an_application() {
    let Some(mut stage) = Stage::start(RULES, "") else { return };
    let session = stage.session();
    let answer = |query: Query| {
        let question = query.payload().map(|bytes| bytes.to_bytes().into_owned()).unwrap_or_default();
        let number: serde_json::Value = serde_json::from_slice(&question).expect("JSON");
        let text = format!(r#"{{"text":"{} is fine"}}"#, number["number"]);
        let key = query.key_expr().clone();
        query.reply(key, text).wait().expect("the bridge waits");
    };
    let key = stage.key("n/operator/robot.question");
    session.declare_queryable(key).callback(answer).background().wait().expect("a key");
    let token = session.liveliness().declare_token(stage.key("@z/operator")).wait().expect("a key");
    // It starts when the name is there.
    stage.robot.wait_for(&["answer: 7 is fine"]);
    stage.wait_for_count("asked_out", 1);
    token.undeclare().wait().expect("a session");
    stage.bridge.wait_for(&["operator has gone"]);
}
