//! `sinew send` to applications in a node's process and in separate ones, on this node and on another.

use std::time::Duration;

use rustix::process::Signal;
use serde_json::{Value, json};
use sinew::{
    Endpoint, NodeApi, Outcome, Registration, Tid,
    client::Received,
    message::{Kind, Rejection},
};
use sinew_testkit::until;

use crate::scenario::{Scenario, named};

#[test]
fn message_arrives_and_its_outcome_is_shown() {
    // Given: two nodes; messages to one of them go through the other
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &["--requires", "knee"]);
    let mut knee = scenario.start("knee", 2, &[]);
    hip.wait_for(&["started"]);
    let tid = knee.wait_for(&["started"]).split_once(' ').expect("it says its TID").1.to_owned();
    for (target, number) in [("knee", 7), (&tid, 8)] {
        // When
        let payload = json!({ "number": number }).to_string();
        let answer = scenario.sinew("hip", &["send", target, "scenario.count", &payload, "--json"]);
        // Then
        assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
        assert_eq!((&answer.json()["outcome"], &answer.json()["tid"]), (&json!("Delivered"), &json!(tid)));
        knee.wait_for(&[&format!("count {number} ")]);
    }
    // And: as a Stream, which is never confirmed, and by the number of its kind
    let kind = format!("{:#x}", Kind::named("scenario.count").bits());
    let answer = scenario.sinew("hip", &["send", "knee", &kind, r#"{"number":9}"#, "--class", "stream"]);
    assert!(answer.code == Some(0) && answer.out.contains("sent"), "{}{}", answer.out, answer.err);
    knee.wait_for(&["count 9 "]);
}

#[test]
fn undelivered_message_is_a_finding_with_the_reason() {
    let scenario = Scenario::new();
    let mut knee = scenario.start("knee", 2, &[]);
    let tid = knee.wait_for(&["started"]).split_once(' ').expect("it says its TID").1.to_owned();
    for (words, code, part) in [
        (
            &[&*tid, "scenario.counted"][..],
            1,
            "; it handles scenario.count, scenario.sized, scenario.stamp; nearest: scenario.count",
        ),
        (
            &[&*tid, "scenario.count", r#"{"nummer":1}"#],
            1,
            ". The log of node knee names the field that does not fit",
        ),
        (&["127.0.0.2/1fff", "scenario.count"], 1, "NoSuchApplication"),
        (&["127.0.0.9/1fff", "scenario.count"], 1, "NoSuchNode"),
        (
            &["kneee", "scenario.count"],
            1,
            "no group with members is called `kneee`; nearest: knee (application)",
        ),
        (&["kneee", "scenario.count", "--unconfirmed"], 1, "nearest: knee (application)"),
        (&["kneee", "scenario.count", "--ask"], 1, "nearest: knee (application)"),
        (&[&"k".repeat(64), "scenario.count"], 1, "it has 64 bytes, and a name has at most 63"),
        // A group without members is no finding if the target can only be a group.
        (&[&Tid::group("legs").to_string(), "scenario.count"], 0, "reached no application"),
        (&[&*tid, "scenario.count", "{number:1}"], 2, "JSON"),
        (&[&*tid, "0x13"], 2, "0x13"),
    ] {
        let answer = scenario.sinew("knee", &[&["send"], words].concat());
        let text = answer.out + &answer.err;
        assert!(answer.code == Some(code) && text.contains(part), "{words:?}: {text}");
    }
    // With `--json`, a failure is JSON, too.
    let answer = scenario.sinew("knee", &["send", "ankle", "scenario.count", "--json"]);
    assert!(answer.code == Some(1) && answer.json()["members"] == json!([]), "{}", answer.out);
    assert!(answer.json()["fault"].as_str().is_some_and(|why| why.contains("`ankle`")), "{}", answer.out);
    let answer = scenario.sinew("knee", &["send", "a|b", "scenario.count", "--json"]);
    assert!(answer.json()["fault"].as_str().is_some_and(|why| why.contains("a|b")), "{}", answer.out);
}

#[test]
fn reply_is_printed_decoded() {
    // Given: an application of another process that replies with the received payload, and a slow one
    let scenario = Scenario::new();
    let _knee = scenario.start("knee", 2, &[]);
    let api = NodeApi::connect(scenario.socket("knee")).expect("the knee's socket");
    let mut client =
        api.register_transport_address(Registration::new().name("echo")).expect("it is registered");
    let echo = std::thread::spawn(move || {
        let request = client.receive(Duration::from_secs(60)).expect("its node lives").expect("a request");
        let mut reply = client
            .create_message(request.source(), request.kind(), request.bytes().len())
            .expect("there is room");
        reply.copy_from_slice(request.bytes());
        client.loaned(reply).reply_to(&request).expect("it is sent");
        request.settle(Outcome::Delivered);
        client
    });
    scenario.until("it is ready", "knee", &["apps"], |json| {
        named(&json["apps"], "echo").is_some_and(|app| app["ready"] == true)
    });
    // When
    let payload = json!({ "joints": ["hip", "knee"], "gain": 0.25, "on": null });
    let answer = scenario.sinew("knee", &["send", "echo", "test.echo", &payload.to_string(), "--ask"]);
    // Then: only the reply is printed, for use in a pipe
    assert_eq!(answer.code, Some(0), "{}{}", answer.out, answer.err);
    assert_eq!(serde_json::from_str::<Value>(&answer.out).ok(), Some(payload));
    // And: a missing reply is a finding
    let client = echo.join().expect("it has replied");
    let answer = scenario.sinew("knee", &["send", "echo", "test.echo", "--ask", "--within", "50"]);
    assert!(answer.code == Some(1) && answer.out.contains("50ms"), "{}{}", answer.out, answer.err);
    drop(client);
}

#[test]
fn message_to_a_waiting_application_names_its_requirement() {
    // Given
    let scenario = Scenario::new();
    let _knee = scenario.start("knee", 2, &["--requires", "ankle"]);
    scenario.until("the knee waits", "knee", &["apps"], |json| {
        named(&json["apps"], "knee").is_some_and(|app| app["state"] == "waits")
    });
    // When
    let words = ["send", "knee", "scenario.count", r#"{"number":1}"#, "--within", "50"];
    let answer = scenario.sinew("knee", &words);
    // Then
    let text = answer.out + &answer.err;
    assert!(answer.code == Some(1) && text.contains("it is not ready: has waited "), "{text}");
    assert!(text.contains("ankle (not there)"), "{text}");
}

#[test]
fn group_outcome_has_a_line_for_each_member() {
    // Given: three nodes, each with a member in a separate process
    let scenario = Scenario::new();
    let _nodes = [scenario.start("hip", 1, &[]), scenario.start("knee", 2, &[])];
    let mut shank = scenario.start("shank", 3, &[]);
    let join = |node: &str| {
        let api = NodeApi::connect(scenario.socket(node)).expect("its socket");
        let name = format!("{node}.drive");
        let mut drive =
            api.register_transport_address(Registration::new().name(&name)).expect("it is registered");
        drive.join("drives").expect("it is in few groups");
        drive
    };
    let (mut takes, mut refuses, mut hangs) = (join("hip"), join("knee"), join("shank"));
    let tids = [&takes, &refuses, &hangs].map(|drive| drive.tid().to_string());
    let api = NodeApi::connect(scenario.socket("hip")).expect("its socket");
    let mut requester = api.register_transport_address(Registration::new()).expect("it is registered");
    until("the hip knows that all three nodes have members", || {
        let look = requester
            .create_message(Tid::group("drives"), Kind::named("test.look"), 0)
            .expect("there is room");
        let members = requester.loaned(look).confirmed_by_each(Duration::from_millis(1));
        (members.expect("it is sent").len() == 3).then_some(())
    });
    // When: each member takes its copy, and the node of the third is killed while the member handles it
    let handling = std::thread::spawn(move || {
        copy_for(&mut takes).settle(Outcome::Delivered);
        copy_for(&mut refuses).settle(Outcome::Rejected(Rejection::UnknownKind));
        let in_hand = copy_for(&mut hangs);
        shank.signal(Signal::KILL);
        shank.wait_for_exit();
        drop(in_hand);
        (takes, refuses)
    });
    let words = ["send", "drives", "test.stop", "--within", "30000"];
    let answer = scenario.sinew("hip", &words);
    let _members = handling.join().expect("all have a copy");
    // Then
    let text = format!("{}{}", answer.out, answer.err);
    let lines: Vec<_> = answer.out.lines().collect();
    assert!(answer.code == Some(1) && lines.len() == 4, "{text}");
    assert!(lines[0].contains("delivered to 1 of 3 members"), "{text}");
    assert_eq!(lines[1], format!("hip.drive ({}): Delivered", tids[0]));
    let refused = format!("knee.drive ({}): Rejected(UnknownKind): ", tids[1]);
    assert!(lines[2].starts_with(&refused), "{text}");
    assert!(lines[3].starts_with(&format!("{}: Unknown: ", tids[2])), "{text}");
}

/// Returns the next `test.stop` message for `drive`, and ignores all other messages.
fn copy_for(drive: &mut Endpoint) -> Received {
    let stop = Kind::named("test.stop");
    loop {
        let received = drive.receive(Duration::from_secs(60)).expect("its node lives").expect("its copy");
        if received.kind() == stop {
            return received;
        }
    }
}
