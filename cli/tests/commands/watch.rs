//! `sinew watch` of applications here and on another node.

use std::{
    io::{BufRead, BufReader},
    process::{Command, Stdio},
};

use serde_json::Value;
use sinew::Kind;

use crate::scenario::Scenario;

/// Each line as JSON.
fn lines(text: &str) -> Vec<Value> {
    text.lines()
        .map(|line| serde_json::from_str(line).unwrap_or_else(|why| panic!("{why}: {line}")))
        .collect()
}

#[test]
fn what_an_application_gets_and_sends_is_seen_decoded_from_either_node() {
    // Given: the hip sends counts to the knee
    let scenario = Scenario::new();
    let mut hip = scenario.start("hip", 1, &["--requires", "knee", "--sends-to", "knee"]);
    let mut knee = scenario.start("knee", 2, &[]);
    hip.wait_for(&["started"]);
    knee.wait_for(&["count 5 "]);
    for here in ["hip", "knee"] {
        for (whom, is_sent) in [("hip", true), ("knee", false)] {
            // When
            let answer = scenario.sinew(here, &["watch", whom, "--count", "20", "--json"]);
            // Then: all of them, in order
            assert_eq!(answer.code, Some(0), "{}", answer.err);
            let said = lines(&answer.out);
            let messages: Vec<_> = said.iter().filter(|line| line["event"] == "message").collect();
            assert_eq!(messages.len(), 20);
            let numbers: Vec<_> =
                messages.iter().map(|m| m["payload"]["number"].as_u64().expect("a count")).collect();
            assert!(numbers.windows(2).all(|pair| pair[0] + 1 == pair[1]), "{numbers:?}");
            for message in messages {
                assert_eq!((&message["sent"], &message["kind"]), (&is_sent.into(), &"scenario.count".into()));
                assert_eq!((&message["class"], &message["source_name"]), (&"bulk".into(), &"hip".into()));
                assert!(message["refused"].is_null() && message["age_ns"].is_u64(), "{message}");
            }
            let rates: Vec<_> = said.iter().filter(|line| line["event"] == "rates").collect();
            let counted: u64 = rates
                .iter()
                .flat_map(|r| r["kinds"].as_array())
                .flatten()
                .filter_map(|k| k["count"].as_u64())
                .sum();
            assert_eq!(counted, 20, "{rates:?}");
        }
    }
    // And: for people, and only what was asked for
    let text = scenario.sinew("hip", &["watch", "knee", "--count", "3"]).out;
    assert!(text.contains("-> scenario.count") && text.contains(r#"{"number":"#), "{text}");
    let none = scenario.sinew("hip", &["watch", "knee", "--sent", "--for", "1", "--json"]);
    assert!(lines(&none.out).iter().all(|line| line["event"] == "rates"), "{}", none.out);
    let other = scenario.sinew("hip", &["watch", "knee", "--kind", "test.other", "--for", "1", "--json"]);
    assert!(lines(&other.out).iter().all(|line| line["event"] == "rates"), "{}", other.out);
}

#[test]
fn a_message_that_is_refused_is_seen_with_the_reason() {
    // Given: somebody watches the knee
    let scenario = Scenario::new();
    let mut knee = scenario.start("knee", 2, &[]);
    let tid = knee.wait_for(&["started"]).split_once(' ').expect("it says its TID").1.to_owned();
    let socket = scenario.socket("knee");
    let mut command = Command::new(env!("CARGO_BIN_EXE_sinew"));
    command.arg("--socket").arg(&socket).args(["watch", "127.0.0.2/1fff", "--count", "1", "--json"]);
    let mut watcher = command.stdout(Stdio::piped()).spawn().expect("the command starts");
    let mut out = BufReader::new(watcher.stdout.take().expect("its output is a pipe"));
    let mut first = String::new();
    // When: it watches, somebody sends to an address that nobody has
    while !first.contains("\"message\"") {
        scenario.sinew("knee", &["send", "127.0.0.2/1fff", "test.any", "[1]", "--unconfirmed"]);
        first.clear();
        out.read_line(&mut first).expect("it lives");
    }
    // Then
    let seen: Value = serde_json::from_str(&first).expect("JSON");
    assert_eq!((&seen["refused"], &seen["payload"]), (&"NoSuchApplication".into(), &serde_json::json!([1])));
    assert_eq!(seen["kind"], format!("{}", Kind::named("test.any")), "nobody has said what this is called");
    assert_eq!(watcher.wait().expect("it ends").code(), Some(0));
    drop(tid);
}
